//! Results that others have published.

use std::fmt::Write;

use super::{RELEASED, TRAINED_ON_BOTH};

/// `[packed GSR, packed DR, pile GSR, pile DR]` of the paper's table of results, in %.
pub(super) const PUBLISHED: [(&str, [&str; 4]); 6] = [
    ("shaf (proposals)", ["56.6 ± 2.0", "58.0 ± 3.0", "50.7 ± 1.7", "42.6 ± 2.8"]),
    ("gpd", ["35.4 ± 1.9", "30.7 ± 2.0", "17.7 ± 2.3", "9.2 ± 1.3"]),
    ("vgn", ["74.5 ± 1.3", "79.2 ± 2.3", "60.7 ± 4.2", "44.0 ± 4.9"]),
    (RELEASED, ["74.4 ± 3.6", "79.8 ± 3.1", "62.5 ± 2.4", "46.4 ± 2.9"]),
    ("transformer", OF_PAPER),
    ("transformer-small", OF_PAPER),
];

const OF_PAPER: [&str; 4] = ["79.7 ± 2.0", "85.9 ± 1.7", "66.9 ± 3.0", "50.9 ± 3.5"];

/// The same for networks trained on the other scenario.
pub(super) const PUBLISHED_CROSSED: [(&str, [&str; 4]); 3] = [
    (RELEASED, ["60.1 ± 1.8", "63.2 ± 1.8", "44.9 ± 1.2", "33.5 ± 1.3"]),
    ("transformer", CROSSED_OF_PAPER),
    ("transformer-small", CROSSED_OF_PAPER),
];

const CROSSED_OF_PAPER: [&str; 4] = ["74.0 ± 2.8", "78.9 ± 2.7", "49.5 ± 1.4", "39.8 ± 1.7"];

/// Results of networks by others: GSR and DR in %, and the quality down to which the best grasp is executed (`force`), each
/// on packed scenes and on piles.
const OTHERS: [(&str, [&str; 2], [&str; 2]); 5] = [
    ("VGN", ["72.5 / 76.7", "59.3 / 43.5"], ["–", "–"]),
    ("GIGA", ["84.8 / 85.1", "69.5 / 49.0"], ["0.5", "0.5"]),
    ("IGD", ["92.9 / 86.7", "68.2 / 50.6"], ["0.4", "0.2"]),
    ("EquiGIGA", ["96.8 / 88.6", "76.6 / 76.4"], ["0.6", "0.3"]),
    ("EquiIGD", ["97.4 / 91.4", "78.6 / 78.0"], ["0.4", "0.01"]),
];

/// Milliseconds on an RTX 3090, packed and pile: mean and standard deviation.
const PUBLISHED_TIMES: [(&str, [(f64, f64); 2]); 3] = [
    (RELEASED, [(11.0, 0.5), (11.2, 0.6)]),
    ("transformer", [(24.3, 0.7), (24.6, 1.1)]),
    ("transformer-small", [(24.3, 0.7), (24.6, 1.1)]),
];

/// The published times of a method.
pub(super) fn published_times(method: &str) -> Option<[(f64, f64); 2]> {
    let method = method.strip_suffix(TRAINED_ON_BOTH).unwrap_or(method);
    PUBLISHED_TIMES.into_iter().find_map(|(name, times)| (name == method).then_some(times))
}

/// The results of [`OTHERS`].
pub(super) fn others(text: &mut String) {
    text.push_str(
        "\nPublished by others (Song et al., arXiv 2507.18847, table I): one noisy side view, PyBullet, VGN's test objects, GSR /\n\
         DR in %. With a lower `force` more objects are cleared.\n\n\
         | | packed | pile | `force`, packed | `force`, pile |\n|---|---|---|---|---|\n",
    );
    for (method, [packed, pile], [packed_force, pile_force]) in OTHERS {
        let _ = writeln!(text, "| {method} | {packed} | {pile} | {packed_force} | {pile_force} |");
    }
}

//! The tables of *6-DoF Robotic Grasping with Transformer*: our results beside the published ones.

mod published;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;

use serde::{Deserialize, Serialize};

use crate::score::{Spread, Summary};
use published::{PUBLISHED, PUBLISHED_CROSSED, others, published_times};

/// Name of a scenario of the benchmark in the results.
pub type Scenario = &'static str;

/// Both scenarios.
pub const SCENARIOS: [Scenario; 2] = ["packed", "pile"];

/// Camera views for which networks are evaluated, with their names in the tables; the paper's view first.
pub const VIEWS: [(&str, &str); 5] = [
    ("side", "side view (paper)"),
    ("side:90", "side view + 90°"),
    ("side:180", "side view + 180°"),
    ("random:1-6", "1–6 random views"),
    ("circle", "6 views from above"),
];

/// Values of ε in the threshold table, in hundredths.
pub const EPSILONS: [u8; 3] = [80, EPSILON, 95];

/// ε in all other tables, in hundredths.
pub const EPSILON: u8 = 90;

/// Name of the procedural test objects. Other object sets have the name of their folder.
pub const TEST_OBJECTS: &str = "test";

/// A simulator in which the benchmark runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Simulator {
    /// This crate.
    Rapier,
    /// `sim/pybullet`.
    PyBullet,
}

impl Simulator {
    /// Name in the tables.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Rapier => "rapier",
            Self::PyBullet => "PyBullet",
        }
    }
}

/// The configuration of a benchmark run.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Condition {
    /// Name of the planner in the tables.
    pub method: String,
    /// The scenario that its network was trained on; `None` for several, or without a network.
    pub trained_on: Option<String>,
    /// The scenario of the scenes.
    pub scenario: String,
    /// Object set: [`TEST_OBJECTS`], or the name of a folder.
    pub objects: String,
    /// The simulator.
    pub simulator: Simulator,
    /// Camera views.
    pub views: String,
    /// ε, the smallest quality of a grasp, in hundredths.
    pub epsilon: u8,
    /// If no grasp reaches ε: whether the best grasp is executed if its quality is at least 0.5.
    pub forced: bool,
    /// Whether the scale of the depths is corrected by the table (`Workspace.correct_depth_scale`).
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub is_scale_corrected: bool,
}

impl Condition {
    /// Whether the planner was not trained on the other scenario only.
    fn is_same_scenario(&self) -> bool {
        self.trained_on.as_ref().is_none_or(|trained_on| *trained_on == self.scenario)
    }

    /// Whether it is the paper's: its view, its ε, `force`, the depths as measured, and the test objects.
    fn is_as_published(&self) -> bool {
        self.objects == TEST_OBJECTS
            && self.views == VIEWS[0].0
            && self.epsilon == EPSILON
            && self.forced
            && !self.is_scale_corrected
    }

    /// The same, in rapier.
    fn is_as_published_in_rapier(&self) -> bool {
        self.is_as_published() && self.simulator == Simulator::Rapier
    }
}

/// The measurements.
#[derive(Clone, Debug, Default)]
pub struct Results {
    /// One summary per seed.
    pub conditions: BTreeMap<Condition, Vec<Summary>>,
    /// Planning time in milliseconds by method and scenario, one observation at a time.
    pub times: BTreeMap<(String, String), Spread>,
    /// Training data by file name of the network: numbers of scenes and grasps.
    pub data: BTreeMap<String, (String, String)>,
    /// Number of test objects by scenario.
    pub test_objects: BTreeMap<String, usize>,
}

/// Name of VGN's released weights, as in the paper.
pub const RELEASED: &str = "VGN-R";

/// Suffix of a method whose network was trained on both scenarios.
pub const TRAINED_ON_BOTH: &str = " (both)";

impl Results {
    /// The tables in Markdown, without a title.
    #[must_use]
    pub fn markdown(&self) -> String {
        let mut text = String::new();
        self.data(&mut text);
        text.push_str("\n## Table 2: clutter removal\n\n");
        self.success(&mut text, &PUBLISHED, &self.simulators(), Condition::is_same_scenario);
        others(&mut text);
        self.other_objects(&mut text);
        text.push_str("\n## Table 3: planning time, ms\n\n");
        self.times(&mut text);
        text.push_str("\n## Table 4: generalisation to the other scenario\n\n");
        text.push_str(
            "Networks trained on one scenario, evaluated on the other. The card of a network says whether its training started\n\
             with the weights of the other scenario.\n\n",
        );
        self.success(&mut text, &PUBLISHED_CROSSED, &[Simulator::Rapier], |condition| !condition.is_same_scenario());
        text.push_str("\n## Threshold ε\n\n");
        self.epsilons(&mut text);
        text.push_str("\n## Camera views\n\n");
        self.views(&mut text);
        text.push_str("\n## Corrected depth scale\n\n");
        self.corrected(&mut text);
        text.push_str("\n## Outcomes\n\n");
        self.endings(&mut text);
        text
    }

    fn data(&self, text: &mut String) {
        text.push_str("## Table 1: training data\n\n| | scenes | grasps | test objects |\n|---|---|---|---|\n");
        text.push_str("| pile, published | 83,305 | 1,564,546 | 40 |\n| packed, published | 16,640 | 638,012 | 16 |\n");
        for scenario in SCENARIOS {
            let objects = self.test_objects.get(scenario).map_or_else(String::new, usize::to_string);
            let _ = writeln!(text, "| {scenario}, ours | | | {objects} |");
        }
        for (file, (scenes, grasps)) in &self.data {
            let _ = writeln!(text, "| `{file}` | {scenes} | {grasps} | |");
        }
    }

    /// The simulators with results.
    fn simulators(&self) -> Vec<Simulator> {
        self.conditions.keys().map(|condition| condition.simulator).collect::<BTreeSet<_>>().into_iter().collect()
    }

    fn success(
        &self,
        text: &mut String,
        published: &[(&str, [&str; 4])],
        simulators: &[Simulator],
        is_wanted: impl Fn(&Condition) -> bool,
    ) {
        let columns = SCENARIOS.into_iter().flat_map(|scenario| [(scenario, "GSR"), (scenario, "DR")]);
        text.push('|');
        for (scenario, figure) in columns {
            for simulator in simulators {
                let _ = write!(text, " | {scenario} {figure} %, {}", simulator.name());
            }
            text.push_str(" | published");
        }
        let _ = writeln!(text, " |\n|{}", "---|".repeat(1 + 4 * (simulators.len() + 1)));
        let conditions =
            || self.conditions.iter().filter(|(condition, _)| condition.is_as_published() && is_wanted(condition));
        for method in in_order(conditions().map(|(condition, _)| condition.method.as_str())) {
            let name = method.strip_suffix(TRAINED_ON_BOTH).unwrap_or(method);
            let of_method = published.iter().find(|(other, _)| *other == name).map(|(_, figures)| figures);
            let _ = write!(text, "| {method} ");
            for (column, scenario) in SCENARIOS.into_iter().enumerate() {
                let summaries = |simulator| {
                    let is_it = |condition: &Condition| {
                        (condition.method.as_str(), condition.scenario.as_str(), condition.simulator)
                            == (method, scenario, simulator)
                    };
                    conditions().find(|(condition, _)| is_it(condition)).map(|(_, summaries)| summaries)
                };
                let figures: [fn(&Summary) -> f64; 2] = [|summary| summary.gsr, |summary| summary.dr];
                for (index, figure) in figures.into_iter().enumerate() {
                    for &simulator in simulators {
                        let ours =
                            summaries(simulator).map_or_else(|| "–".to_owned(), |summaries| spread(summaries, figure));
                        let _ = write!(text, "| {ours} ");
                    }
                    let _ = write!(text, "| {} ", of_method.map_or("–", |figures| figures[2 * column + index]));
                }
            }
            text.push_str("|\n");
        }
    }

    /// One table per other object set.
    fn other_objects(&self, text: &mut String) {
        let is_other = |condition: &Condition| condition.objects != TEST_OBJECTS && !condition.is_scale_corrected;
        for objects in self.object_sets(is_other) {
            let _ = write!(text, "\n### Objects of `{objects}`\n\nGSR / DR in %, pooled.\n\n");
            self.by_simulator(text, |condition| is_other(condition) && condition.objects == objects, of_first_seed);
        }
    }

    /// One table per object set, each cell with the depths as measured and with a corrected scale.
    fn corrected(&self, text: &mut String) {
        text.push_str(
            "GSR / DR in %, pooled, with the paper's view: with the depths as measured → with their scale corrected by the\n\
             height of the table (`Workspace.correct_depth_scale`).\n",
        );
        for objects in self.object_sets(|condition| condition.is_scale_corrected) {
            let _ = write!(text, "\n### Objects of `{objects}`, corrected\n\n");
            let is_wanted = |condition: &Condition| condition.is_scale_corrected && condition.objects == objects;
            self.by_simulator(text, is_wanted, |results, condition| {
                let measured = Condition { is_scale_corrected: false, ..condition.clone() };
                format!("{} → {}", of_first_seed(results, &measured), of_first_seed(results, condition))
            });
        }
    }

    /// The object sets of these conditions.
    fn object_sets(&self, is_wanted: impl Fn(&Condition) -> bool) -> BTreeSet<&str> {
        self.conditions.keys().filter(|condition| is_wanted(condition)).map(|c| c.objects.as_str()).collect()
    }

    /// A table with a row for each method of these conditions, and a column for each scenario in each simulator.
    fn by_simulator(
        &self,
        text: &mut String,
        is_wanted: impl Fn(&Condition) -> bool,
        cell: impl Fn(&Self, &Condition) -> String,
    ) {
        let columns: Vec<_> = SCENARIOS
            .into_iter()
            .flat_map(|scenario| self.simulators().into_iter().map(move |simulator| (scenario, simulator)))
            .collect();
        text.push('|');
        columns.iter().for_each(|(scenario, simulator)| {
            let _ = write!(text, " | {scenario}, {}", simulator.name());
        });
        let _ = writeln!(text, " |\n|{}", "---|".repeat(1 + columns.len()));
        let conditions = || self.conditions.keys().filter(|condition| is_wanted(condition));
        for method in in_order(conditions().map(|condition| condition.method.as_str())) {
            let _ = write!(text, "| {method} |");
            for &(scenario, simulator) in &columns {
                let is_it = |condition: &&Condition| {
                    (condition.method.as_str(), condition.scenario.as_str(), condition.simulator)
                        == (method, scenario, simulator)
                };
                let _ = write!(
                    text,
                    " {} |",
                    conditions().find(is_it).map_or_else(|| "–".to_owned(), |condition| cell(self, condition))
                );
            }
            text.push('\n');
        }
    }

    fn times(&self, text: &mut String) {
        text.push_str("| | packed | published | pile | published |\n|---|---|---|---|---|\n");
        for method in in_order(self.times.keys().map(|(method, _)| method.as_str())) {
            let published = published_times(method);
            let mut row = format!("| {method} ");
            for (column, scenario) in SCENARIOS.into_iter().enumerate() {
                let ours = self.times.get(&(method.to_owned(), scenario.to_owned()));
                let ours = ours.map_or_else(
                    || "–".to_owned(),
                    |time| format!("{:.1} ± {:.1} (n {})", time.mean, time.std.unwrap_or(0.0), time.n),
                );
                let published = published.map(|times| times[column]);
                let published = published.map_or("–".to_owned(), |(mean, std)| format!("{mean:.1} ± {std:.1}"));
                let _ = write!(row, "| {ours} | {published} ");
            }
            text.push_str(&row);
            text.push_str("|\n");
        }
        let mean = |method: &str, scenario| self.times.get(&(method.to_owned(), scenario)).map(|time| time.mean);
        for (method, scenario) in self.times.keys().filter(|(method, _)| method.starts_with("transformer")) {
            let Some(of_vgn) = mean("vgn", scenario.clone()) else { continue };
            let Some(time) = mean(method, scenario.clone()) else { continue };
            let _ = write!(text, "\n{method} on {scenario}: {:.1} times the time of vgn", time / of_vgn);
            let column = SCENARIOS.iter().position(|other| other == scenario);
            let published = |method| Some(published_times(method)?[column?].0);
            match (published(method), published(RELEASED)) {
                (Some(time), Some(of_vgn)) => {
                    let _ = writeln!(text, " (published: {time:.1} / {of_vgn:.1} = {:.1} times).", time / of_vgn);
                }
                _ => text.push_str(".\n"),
            }
        }
    }

    fn epsilons(&self, text: &mut String) {
        text.push_str(
            "GSR / DR in rapier in %, pooled, with the paper's view and without `force`. With `force` the result does not depend\n",
        );
        text.push_str("on ε, because the best grasp is executed.\n\n| |");
        EPSILONS.iter().for_each(|epsilon| text.push_str(&format!(" 0.{epsilon} |")));
        text.push_str(&format!("\n|---|{}\n", "---|".repeat(EPSILONS.len())));
        let strict = self.conditions.keys().filter(|condition| !condition.forced);
        let cell = |epsilon| move |condition: &Condition| Condition { epsilon, forced: false, ..condition.clone() };
        self.rows(text, strict, EPSILONS.map(cell));
    }

    fn views(&self, text: &mut String) {
        text.push_str("GSR / DR in rapier in %, pooled.\n\n| |");
        VIEWS.iter().for_each(|(_, name)| text.push_str(&format!(" {name} |")));
        text.push_str(&format!("\n|---|{}\n", "---|".repeat(VIEWS.len())));
        let others = self.conditions.keys().filter(|condition| condition.views != VIEWS[0].0);
        self.rows(
            text,
            others,
            VIEWS.map(|(views, _)| {
                move |condition: &Condition| Condition { views: views.to_owned(), ..condition.clone() }
            }),
        );
    }

    /// A row for each network and scenario of `conditions`. `cells` derive the condition of each cell.
    fn rows<'a>(
        &self,
        text: &mut String,
        conditions: impl Iterator<Item = &'a Condition>,
        cells: impl IntoIterator<Item = impl Fn(&Condition) -> Condition> + Clone,
    ) {
        let as_published = |condition: &Condition| Condition {
            views: VIEWS[0].0.to_owned(),
            epsilon: EPSILON,
            forced: true,
            ..condition.clone()
        };
        for condition in conditions.map(as_published).collect::<BTreeSet<_>>() {
            let _ = write!(text, "| {} on {} |", condition.method, condition.scenario);
            for cell in cells.clone() {
                let _ = write!(text, " {} |", of_first_seed(self, &cell(&condition)));
            }
            text.push('\n');
        }
    }

    fn endings(&self, text: &mut String) {
        text.push_str("Shares of the attempts and of the rounds, in %, with the paper's view in rapier.\n\n");
        text.push_str("| | attempts | success | blocked at the pre-grasp | empty grasp | object lost in the lift | ");
        text.push_str("rounds | cleared | no object visible | no grasp | two failures |\n");
        text.push_str("|---|---|---|---|---|---|---|---|---|---|---|\n");
        let conditions = || self.conditions.iter().filter(|(condition, _)| condition.is_as_published_in_rapier());
        let methods = in_order(conditions().map(|(condition, _)| condition.method.as_str()));
        for (condition, summaries) in
            methods.iter().flat_map(|method| conditions().filter(|(condition, _)| condition.method == *method))
        {
            let sum = |figure: fn(&Summary) -> usize| summaries.iter().map(figure).sum::<usize>();
            let share = |part: usize, whole: usize| match whole {
                0 => "–".to_owned(),
                whole => format!("{:.1}", part as f64 / whole as f64 * 100.0),
            };
            let (attempts, rounds) = (sum(|s| s.attempts), sum(|s| s.rounds));
            let of_attempts = [
                sum(|s| s.successes),
                sum(|s| s.blocked_at_pregrasp),
                sum(|s| s.closed_on_nothing),
                sum(|s| s.lost_in_lift),
            ]
            .map(|part| share(part, attempts));
            let of_rounds =
                [sum(|s| s.cleared), sum(|s| s.nothing_seen), sum(|s| s.nothing_proposed), sum(|s| s.gave_up)]
                    .map(|part| share(part, rounds));
            let _ = writeln!(
                text,
                "| {} on {} | {attempts} | {} | {rounds} | {} |",
                name(condition),
                condition.scenario,
                of_attempts.join(" | "),
                of_rounds.join(" | ")
            );
        }
    }
}

/// Sorted without duplicates: the baselines in the paper's order, then the networks by name.
fn in_order<'a>(methods: impl Iterator<Item = &'a str>) -> Vec<&'a str> {
    const BASELINES: [&str; 6] = ["random", "shaf", "shaf (proposals)", "gpd", RELEASED, "vgn"];
    let mut methods: Vec<&str> = methods.collect();
    let rank = |method: &str| BASELINES.iter().position(|name| *name == method).unwrap_or(BASELINES.len());
    methods.sort_unstable_by_key(|method| (rank(method), *method));
    methods.dedup();
    methods
}

fn name(condition: &Condition) -> String {
    match &condition.trained_on {
        Some(other) if *other != condition.scenario => format!("{}, trained on {other},", condition.method),
        _ => condition.method.clone(),
    }
}

fn spread(summaries: &[Summary], figure: fn(&Summary) -> f64) -> String {
    let values: Vec<f64> = summaries.iter().map(figure).collect();
    Spread::new(&values).map_or_else(|| "–".to_owned(), |spread| spread.percent())
}

/// GSR and DR of a condition with its first seed: only the conditions of the paper are measured with the others.
fn of_first_seed(results: &Results, condition: &Condition) -> String {
    let summary = results.conditions.get(condition).and_then(|summaries| summaries.first());
    summary.map_or_else(|| "–".to_owned(), gsr_and_dr)
}

fn gsr_and_dr(summary: &Summary) -> String {
    let successes = summary.successes as f64 * 100.0;
    format!("{:.1} / {:.1}", successes / summary.attempts.max(1) as f64, successes / summary.objects.max(1) as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn views_and_corrections_are_compared_on_the_first_seed() {
        let measured = Condition {
            method: "vgn".to_owned(),
            trained_on: None,
            scenario: "packed".to_owned(),
            objects: TEST_OBJECTS.to_owned(),
            simulator: Simulator::Rapier,
            views: VIEWS[0].0.to_owned(),
            epsilon: EPSILON,
            forced: true,
            is_scale_corrected: false,
        };
        let corrected = Condition { is_scale_corrected: true, ..measured.clone() };
        let from_above = Condition { views: "circle".to_owned(), ..measured.clone() };
        let summary = |successes| Summary { attempts: 10, objects: 10, successes, ..Summary::default() };
        let conditions = BTreeMap::from([
            (measured, vec![summary(4), summary(8)]),
            (corrected, vec![summary(5)]),
            (from_above, vec![summary(6)]),
        ]);
        let text = Results { conditions, ..Results::default() }.markdown();
        assert!(text.contains("| vgn | 40.0 / 40.0 → 50.0 / 50.0 |"), "{text}");
        assert!(text.contains("| vgn on packed | 40.0 / 40.0 | – | – | – | 60.0 / 60.0 |"), "{text}");
    }
}

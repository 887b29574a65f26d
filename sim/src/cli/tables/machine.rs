use std::fs;

/// The processor and its number of cores. Names of processors in virtual machines are short, so family and model follow.
pub(super) fn machine() -> String {
    let text = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let value = |key: &str| {
        let mut pairs = text.lines().filter_map(|line| line.split_once(':'));
        pairs.find_map(|(name, value)| (name.trim() == key).then(|| value.trim().to_owned()))
    };
    let cores = std::thread::available_parallelism().map_or(1, |n| n.get());
    match [value("model name"), value("cpu family"), value("model")] {
        [Some(name), Some(family), Some(model)] => {
            format!("{name} (family {family}, model {model}) with {cores} cores")
        }
        [name, ..] => format!("{} with {cores} cores", name.as_deref().unwrap_or("unknown processor")),
    }
}

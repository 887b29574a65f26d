use std::collections::BTreeMap;
use std::time::Duration;

/// Rows of numbers below a title.
pub(crate) struct Table {
    title: String,
    columns: Vec<String>,
    rows: Vec<(String, Vec<f64>)>,
}

impl Table {
    pub fn new(title: &str, columns: &[&str]) -> Self {
        Self {
            title: title.to_owned(),
            columns: columns.iter().map(|&column| column.to_owned()).collect(),
            rows: vec![],
        }
    }

    /// What is not known is NaN.
    pub fn row<const N: usize>(&mut self, name: &str, numbers: [f64; N]) {
        self.rows.push((name.to_owned(), numbers.to_vec()));
    }

    pub fn print(&self) {
        let width = self.rows.iter().map(|(name, _)| name.chars().count()).max().unwrap_or(0);
        println!("\n{}", self.title);
        let columns: Vec<String> = self.columns.iter().map(|column| format!("{column:>17}")).collect();
        println!("{:width$}{}", "", columns.concat());
        for (name, numbers) in &self.rows {
            let numbers = numbers.iter().map(|number| match number {
                number if number.is_nan() => format!("{:>17}", "–"),
                number if *number >= 100.0 => format!("{number:17.1}"),
                number => format!("{number:17.3}"),
            });
            println!("{name:width$}{}", numbers.collect::<String>());
        }
    }
}

/// What the last line says.
#[derive(Default)]
pub(crate) struct Figures(BTreeMap<String, f64>);

impl Figures {
    pub fn add(&mut self, name: &str, figure: f64) {
        self.0.insert(name.to_owned(), figure);
    }

    pub fn json(&self) -> serde_json::Value {
        self.0.iter().map(|(name, figure)| (name.clone(), (figure * 1e4).round() / 1e4)).collect()
    }
}

pub(crate) fn milliseconds(duration: Duration) -> f64 {
    duration.as_secs_f64() * 1e3
}

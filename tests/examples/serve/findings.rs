use std::collections::BTreeMap;
use std::time::Duration;

use serde_json::{Value, json};

/// A table with a title, and a name for each row of numbers.
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

    /// Adds a row. Unknown numbers are NaN.
    pub fn row<const N: usize>(&mut self, name: &str, numbers: [f64; N]) {
        self.rows.push((name.to_owned(), numbers.to_vec()));
    }

    fn print(&self) {
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

/// All results of a run.
pub(crate) struct Findings {
    conditions: String,
    tables: Vec<Table>,
    figures: BTreeMap<String, f64>,
}

impl Findings {
    pub fn new(conditions: String) -> Self {
        println!("{conditions}");
        Self { conditions, tables: vec![], figures: BTreeMap::new() }
    }

    /// Prints a table, and stores it.
    pub fn table(&mut self, table: Table) {
        table.print();
        self.tables.push(table);
    }

    pub fn figure(&mut self, name: &str, figure: f64) {
        self.figures.insert(name.to_owned(), (figure * 1e4).round() / 1e4);
    }

    /// Adds a table of the targets with the measured figures. Figures that were not measured are left out.
    pub fn compare(&mut self, aims: &[(&str, Aim)]) {
        let mut table = Table::new("Targets", &["aim", "measured", "reached: 1 or 0"]);
        for (name, aim) in aims {
            let Some(&figure) = self.figures.get(*name) else { continue };
            let (sign, aim, reached) = match *aim {
                Aim::AtMost(most) => ("≤", most, figure <= most),
                Aim::AtLeast(least) => ("≥", least, figure >= least),
            };
            table.row(&format!("{name} {sign}"), [aim, figure, f64::from(u8::from(reached))]);
        }
        self.table(table);
    }

    /// The figures as JSON, for the last line of the output.
    pub fn figures(&self) -> Value {
        json!(self.figures)
    }

    pub fn json(&self) -> Value {
        let rows = |table: &Table| -> Vec<Value> {
            table.rows.iter().map(|(name, numbers)| json!({ "name": name, "numbers": numbers })).collect()
        };
        let tables = self
            .tables
            .iter()
            .map(|table| json!({ "title": table.title, "columns": table.columns, "rows": rows(table) }));
        json!({ "conditions": self.conditions, "figures": self.figures, "tables": tables.collect::<Vec<_>>() })
    }
}

/// The target of a figure.
pub(crate) enum Aim {
    AtMost(f64),
    AtLeast(f64),
}

pub(crate) fn milliseconds(duration: Duration) -> f64 {
    duration.as_secs_f64() * 1e3
}

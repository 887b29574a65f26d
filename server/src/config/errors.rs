use std::ffi::OsString;
use std::fmt::{self, Display};

use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::{Arg, Command, Error, Parser, value_parser};

/// All errors of a configuration.
#[derive(Debug, Default)]
pub(crate) struct ConfigErrors(Vec<String>);

impl ConfigErrors {
    /// Parses the command line and the environment. clap stops at the first invalid value, so after each one the
    /// command is parsed again with that flag accepting any value. Unknown flags and `--help` end the process.
    pub(super) fn parse<F: Parser>() -> Result<F, Self> {
        let mut errors = Self::default();
        let mut command = F::command();
        loop {
            match command.clone().try_get_matches() {
                Ok(mut matches) if errors.0.is_empty() => {
                    return F::from_arg_matches_mut(&mut matches).map_err(|error| error.exit());
                }
                Ok(_) => return Err(errors),
                Err(error) => match error.kind() {
                    ErrorKind::ValueValidation | ErrorKind::InvalidValue => {
                        let Some(flag) = flags(&command, &error).pop() else { error.exit() };
                        errors.add_of(&flag, invalid_value(&error));
                        command = command.mut_arg(flag.get_id(), |flag| flag.value_parser(value_parser!(OsString)));
                    }
                    ErrorKind::MissingRequiredArgument => {
                        flags(&command, &error).iter().for_each(|flag| errors.add_of(flag, "is missing"));
                        return Err(errors);
                    }
                    _ => error.exit(),
                },
            }
        }
    }

    /// Adds an error of the flag with this id.
    pub(super) fn add<F: Parser>(&mut self, id: &str, error: impl Display) {
        if let Some(flag) = F::command().get_arguments().find(|flag| flag.get_id() == id) {
            self.add_of(flag, error);
        }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    fn add_of(&mut self, flag: &Arg, error: impl Display) {
        let name = flag.get_long().unwrap_or_default();
        let variable = flag.get_env().unwrap_or_default().to_string_lossy();
        self.0.push(format!("--{name} ({variable}) {error}"));
    }
}

/// The flags that an error of clap is about.
fn flags(command: &Command, error: &Error) -> Vec<Arg> {
    let names = match error.get(ContextKind::InvalidArg) {
        Some(ContextValue::String(name)) => std::slice::from_ref(name),
        Some(ContextValue::Strings(names)) => names,
        _ => &[],
    };
    // The names as clap prints them exist only in a built command, whose flags cannot be changed any more.
    let mut command = command.clone();
    command.build();
    command.get_arguments().filter(|flag| names.contains(&flag.to_string())).cloned().collect()
}

fn invalid_value(error: &Error) -> String {
    let value = error.get(ContextKind::InvalidValue).map(ContextValue::to_string).unwrap_or_default();
    let reason = match (std::error::Error::source(error), error.get(ContextKind::ValidValue)) {
        (Some(source), _) => source.to_string(),
        (None, Some(valid)) => format!("must be one of {valid}"),
        (None, None) => "a value is missing".to_owned(),
    };
    format!("is `{value}`: {reason}")
}

impl Display for ConfigErrors {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        writeln!(f, "graspd: invalid configuration:")?;
        self.0.iter().try_for_each(|error| writeln!(f, "  {error}"))?;
        writeln!(f, "See `graspd --help` for all flags.")
    }
}

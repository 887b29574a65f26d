//! Where a run computes.

use std::str::FromStr;

use anyhow::{Result, ensure};
use tch::{Cuda, Device};

/// What the user asks for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) enum Choice {
    /// The first card, or the processor where there is none.
    #[default]
    Auto,
    Cpu,
    /// The card of this number, and nothing else.
    Cuda(usize),
}

impl FromStr for Choice {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let card = |number: &str| number.parse().map(Self::Cuda).ok();
        let choice = match text {
            "auto" => Some(Self::Auto),
            "cpu" => Some(Self::Cpu),
            "cuda" => Some(Self::Cuda(0)),
            _ => text.strip_prefix("cuda:").and_then(card),
        };
        choice.ok_or_else(|| "must be auto, cpu, cuda, or cuda:N for card N".to_owned())
    }
}

impl Choice {
    /// The device, as far as this machine and this libtorch have it.
    pub fn device(self) -> Result<Device> {
        let cards = if Cuda::is_available() { Cuda::device_count() } else { 0 };
        self.among(usize::try_from(cards).unwrap_or(0))
    }

    /// A card that was asked for and is not there is an error: hours on the processor would be a surprise.
    fn among(self, cards: usize) -> Result<Device> {
        match self {
            Self::Cpu => Ok(Device::Cpu),
            Self::Auto => Ok(if cards > 0 { Device::Cuda(0) } else { Device::Cpu }),
            Self::Cuda(number) => {
                ensure!(
                    number < cards,
                    "--device is cuda:{number}, but libtorch finds {cards} CUDA cards; \
                     LIBTORCH must be a build for CUDA, and its driver must be there (nvidia-smi)"
                );
                Ok(Device::Cuda(number))
            }
        }
    }
}

/// The device, as it is written.
pub(crate) fn name(device: Device) -> String {
    match device {
        Device::Cuda(number) => format!("cuda:{number}"),
        other => format!("{other:?}").to_lowercase(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_device_is_the_one_asked_for_or_an_error() {
        let choice = |text: &str| text.parse::<Choice>().unwrap();
        assert_eq!(choice("auto").among(0).unwrap(), Device::Cpu);
        assert_eq!(choice("auto").among(2).unwrap(), Device::Cuda(0));
        assert_eq!(choice("cpu").among(2).unwrap(), Device::Cpu);
        assert_eq!(choice("cuda").among(1).unwrap(), Device::Cuda(0));
        assert_eq!(choice("cuda:1").among(2).unwrap(), Device::Cuda(1));
        let error = choice("cuda:2").among(2).unwrap_err().to_string();
        assert!(error.contains("cuda:2") && error.contains("2 CUDA cards"), "{error}");
        for wrong in ["", "gpu", "cuda:", "cuda:x", "CUDA"] {
            assert!(wrong.parse::<Choice>().is_err(), "{wrong}");
        }
        assert_eq!([Device::Cpu, Device::Cuda(1)].map(name), ["cpu", "cuda:1"]);
    }
}

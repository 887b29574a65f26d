//! The device of a run.

use std::str::FromStr;

use anyhow::{Result, ensure};
use tch::{Cuda, Device};

/// The value of `--device`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) enum DeviceChoice {
    /// The first GPU, or the CPU if there is none.
    #[default]
    Auto,
    Cpu,
    /// The GPU with this number.
    Cuda(usize),
}

impl FromStr for DeviceChoice {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let gpu = |number: &str| number.parse().map(Self::Cuda).ok();
        let choice = match text {
            "auto" => Some(Self::Auto),
            "cpu" => Some(Self::Cpu),
            "cuda" => Some(Self::Cuda(0)),
            _ => text.strip_prefix("cuda:").and_then(gpu),
        };
        choice.ok_or_else(|| "must be auto, cpu, cuda, or cuda:N for GPU number N".to_owned())
    }
}

impl DeviceChoice {
    /// The device, if this machine and this libtorch have it.
    pub fn device(self) -> Result<Device> {
        let gpus = if Cuda::is_available() { Cuda::device_count() } else { 0 };
        self.among(usize::try_from(gpus).unwrap_or(0))
    }

    /// The device on a machine with this many GPUs. A missing GPU is an error: there is no silent fallback to the CPU.
    fn among(self, gpus: usize) -> Result<Device> {
        match self {
            Self::Cpu => Ok(Device::Cpu),
            Self::Auto => Ok(if gpus > 0 { Device::Cuda(0) } else { Device::Cpu }),
            Self::Cuda(number) => {
                ensure!(
                    number < gpus,
                    "--device is cuda:{number}, but libtorch finds {gpus} CUDA devices; \
                     use a libtorch with CUDA (LIBTORCH) and check the driver with nvidia-smi"
                );
                Ok(Device::Cuda(number))
            }
        }
    }
}

/// The device in the notation of `--device`.
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
    fn a_missing_device_is_an_error() {
        let choice = |text: &str| text.parse::<DeviceChoice>().unwrap();
        assert_eq!(choice("auto").among(0).unwrap(), Device::Cpu);
        assert_eq!(choice("auto").among(2).unwrap(), Device::Cuda(0));
        assert_eq!(choice("cpu").among(2).unwrap(), Device::Cpu);
        assert_eq!(choice("cuda").among(1).unwrap(), Device::Cuda(0));
        assert_eq!(choice("cuda:1").among(2).unwrap(), Device::Cuda(1));
        let error = choice("cuda:2").among(2).unwrap_err().to_string();
        assert!(error.contains("cuda:2") && error.contains("2 CUDA devices"), "{error}");
        for wrong in ["", "gpu", "cuda:", "cuda:x", "CUDA"] {
            assert!(wrong.parse::<DeviceChoice>().is_err(), "{wrong}");
        }
        assert_eq!([Device::Cpu, Device::Cuda(1)].map(name), ["cpu", "cuda:1"]);
    }
}

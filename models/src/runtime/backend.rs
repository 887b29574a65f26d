use std::fmt;
use std::str::FromStr;

use ort::ep::{self, ArbitrarilyConfigurableExecutionProvider, ExecutionProvider, ExecutionProviderDispatch};
use thiserror::Error;

/// What computes a network: one of ONNX Runtime's execution providers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Provider {
    /// ONNX Runtime's own kernels.
    Cpu,
    /// OpenVINO on the CPU.
    OpenVino,
    /// An NVIDIA card.
    Cuda,
    /// An NVIDIA card, by way of an engine that is built for it when the model is loaded.
    TensorRt,
}

/// The numbers that a network is computed in, as far as its provider may choose: sums are never shorter than f32.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Precision {
    /// 32 bits.
    Fp32,
    /// 16 bits, as wide a range as 32, three digits.
    Bf16,
    /// 16 bits, up to 65504, four digits.
    Fp16,
    /// 8 bits, in the scales that the file brings (`grasp-train export --precision int8`).
    Int8,
}

/// What a network is run by, and in which numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Backend {
    /// Which provider.
    pub provider: Provider,
    /// Which precision.
    pub precision: Precision,
}

/// Why a network cannot be run as was asked.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum BackendError {
    /// The library has no such provider.
    #[error(
        "this ONNX Runtime has no provider `{wanted}`, it has {}; set ORT_DYLIB_PATH to a build that does \
         (the wheels onnxruntime-openvino, onnxruntime-gpu)",
        list(there)
    )]
    Provider {
        /// What was asked for.
        wanted: Provider,
        /// What there is.
        there: Vec<Provider>,
    },
    /// The provider does not compute in these numbers, here.
    #[error("the provider `{provider}` does not compute in {wanted} on this machine, it can do {}", list(there))]
    Precision {
        /// Which.
        provider: Provider,
        /// What was asked for.
        wanted: Precision,
        /// What it can do.
        there: Vec<Precision>,
    },
    /// 8 bits need scales, which the file does not hold.
    #[error("the model is no int8 model; `grasp-train export --precision int8` makes one of it")]
    NotInt8,
    /// The file's scales cannot be taken out again.
    #[error("the model is an int8 model, it cannot be computed in {0}; serve the file that it was exported from")]
    Int8(Precision),
}

/// What this machine and this library can do.
#[derive(Clone, Debug)]
pub(crate) struct Machine {
    /// In the order in which they are tried, the fastest first.
    pub providers: Vec<Provider>,
    /// Whether the CPU multiplies bf16.
    pub bf16: bool,
}

impl Machine {
    /// This one. The library lists what it was built with; whether a card is there shows when a session is made.
    pub fn here() -> Self {
        let providers = Provider::FASTEST_FIRST.into_iter().filter(|provider| provider.is_available()).collect();
        Self { providers, bf16: has_bf16() }
    }

    /// The ways to run a model, the first to be tried first; one that was asked for is the only one.
    pub fn backends(
        &self,
        provider: Option<Provider>,
        precision: Option<Precision>,
        is_int8: bool,
    ) -> Result<Vec<Backend>, BackendError> {
        match (is_int8, precision) {
            (false, Some(Precision::Int8)) => return Err(BackendError::NotInt8),
            (true, Some(wanted)) if wanted != Precision::Int8 => return Err(BackendError::Int8(wanted)),
            _ => {}
        }
        let providers = match provider {
            None => self.providers.clone(),
            Some(wanted) if self.providers.contains(&wanted) => vec![wanted],
            Some(wanted) => return Err(BackendError::Provider { wanted, there: self.providers.clone() }),
        };
        let of = |provider| {
            let precisions = if is_int8 { vec![Precision::Int8] } else { self.precisions(provider) };
            precisions.into_iter().map(move |precision| Backend { provider, precision })
        };
        let all: Vec<Backend> = providers.into_iter().flat_map(of).collect();
        let Some(wanted) = precision else { return Ok(all) };
        let fitting: Vec<Backend> = all.iter().copied().filter(|backend| backend.precision == wanted).collect();
        match (fitting.is_empty(), all.last()) {
            (true, Some(&Backend { provider, .. })) => {
                Err(BackendError::Precision { provider, wanted, there: self.precisions(provider) })
            }
            _ => Ok(fitting),
        }
    }

    /// The fastest first.
    fn precisions(&self, provider: Provider) -> Vec<Precision> {
        match provider {
            Provider::TensorRt => vec![Precision::Fp16, Precision::Bf16, Precision::Fp32],
            Provider::OpenVino if self.bf16 => vec![Precision::Bf16, Precision::Fp32],
            Provider::Cpu | Provider::OpenVino | Provider::Cuda => vec![Precision::Fp32],
        }
    }
}

/// Without it OpenVINO would take the hint and compute in f32. Processors with AMX have it, too.
fn has_bf16() -> bool {
    #[cfg(target_arch = "x86_64")]
    return std::arch::is_x86_feature_detected!("avx512bf16");
    #[cfg(not(target_arch = "x86_64"))]
    return false;
}

impl Provider {
    const FASTEST_FIRST: [Self; 4] = [Self::TensorRt, Self::Cuda, Self::OpenVino, Self::Cpu];

    fn is_available(self) -> bool {
        let listed = match self {
            Self::Cpu => Ok(true),
            Self::OpenVino => ep::OpenVINO::is_available(),
            Self::Cuda => ep::CUDA::is_available(),
            Self::TensorRt => ep::TensorRT::is_available(),
        };
        listed.unwrap_or(false)
    }

    /// Its name.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Cpu => "cpu",
            Self::OpenVino => "openvino",
            Self::Cuda => "cuda",
            Self::TensorRt => "tensorrt",
        }
    }
}

impl Precision {
    const ALL: [Self; 4] = [Self::Fp32, Self::Bf16, Self::Fp16, Self::Int8];

    /// Its name.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Fp32 => "fp32",
            Self::Bf16 => "bf16",
            Self::Fp16 => "fp16",
            Self::Int8 => "int8",
        }
    }
}

impl Backend {
    /// ONNX Runtime's own kernels in f32, which every other way is measured by.
    pub const REFERENCE: Self = Self { provider: Provider::Cpu, precision: Precision::Fp32 };

    /// What is registered with a session of so many threads. A provider that cannot be registered is an error: ONNX
    /// Runtime would otherwise go on without it and tell nobody.
    pub(crate) fn dispatch(self, threads: usize) -> Option<ExecutionProviderDispatch> {
        let provider = match self.provider {
            Provider::Cpu => return None,
            Provider::OpenVino => {
                let hint = if self.precision == Precision::Fp32 { "f32" } else { "bf16" };
                let config = format!(
                    r#"{{"CPU":{{"INFERENCE_PRECISION_HINT":"{hint}","INFERENCE_NUM_THREADS":"{threads}","NUM_STREAMS":"1"}}}}"#
                );
                let provider = ep::OpenVINO::default().with_device_type("CPU").with_precision("ACCURACY");
                provider.with_arbitrary_config("load_config", config).build()
            }
            Provider::Cuda => ep::CUDA::default().build(),
            Provider::TensorRt => {
                let provider = ep::TensorRT::default().with_fp16(self.precision == Precision::Fp16);
                provider
                    .with_bf16(self.precision == Precision::Bf16)
                    .with_int8(self.precision == Precision::Int8)
                    .build()
            }
        };
        Some(provider.error_on_failure())
    }
}

/// A name, or `auto`, which leaves the choice to the machine.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Choice<T>(pub Option<T>);

impl<T: FromStr> FromStr for Choice<T> {
    type Err = T::Err;

    fn from_str(text: &str) -> Result<Self, T::Err> {
        if text == "auto" { Ok(Self(None)) } else { text.parse().map(|choice| Self(Some(choice))) }
    }
}

impl<T: fmt::Display> fmt::Display for Choice<T> {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match &self.0 {
            Some(choice) => choice.fmt(f),
            None => f.write_str("auto"),
        }
    }
}

impl fmt::Display for Backend {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{} {}", self.provider, self.precision)
    }
}

impl fmt::Display for Provider {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl fmt::Display for Precision {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// No such name.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq)]
#[error("it must be {0}")]
pub struct NameError(&'static str);

impl FromStr for Provider {
    type Err = NameError;

    fn from_str(name: &str) -> Result<Self, NameError> {
        let found = Self::FASTEST_FIRST.into_iter().find(|provider| provider.name() == name);
        found.ok_or(NameError("auto, cpu, openvino, cuda or tensorrt"))
    }
}

impl FromStr for Precision {
    type Err = NameError;

    fn from_str(name: &str) -> Result<Self, NameError> {
        let found = Self::ALL.into_iter().find(|precision| precision.name() == name);
        found.ok_or(NameError("auto, fp32, bf16, fp16 or int8"))
    }
}

fn list<T: fmt::Display>(items: &[T]) -> String {
    items.iter().map(T::to_string).collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn machine(providers: &[Provider], bf16: bool) -> Machine {
        Machine { providers: providers.to_vec(), bf16 }
    }

    fn names(backends: Result<Vec<Backend>, BackendError>) -> Vec<String> {
        backends.unwrap().iter().map(Backend::to_string).collect()
    }

    const CPU_ONLY: &[Provider] = &[Provider::Cpu];
    const OPENVINO: &[Provider] = &[Provider::OpenVino, Provider::Cpu];
    const GPU: &[Provider] = &[Provider::TensorRt, Provider::Cuda, Provider::Cpu];

    #[test]
    fn auto_tries_the_fastest_first() {
        assert_eq!(names(machine(CPU_ONLY, true).backends(None, None, false)), ["cpu fp32"]);
        assert_eq!(
            names(machine(OPENVINO, true).backends(None, None, false)),
            ["openvino bf16", "openvino fp32", "cpu fp32"]
        );
        assert_eq!(names(machine(OPENVINO, false).backends(None, None, false)), ["openvino fp32", "cpu fp32"]);
        assert_eq!(
            names(machine(GPU, false).backends(None, None, false)),
            ["tensorrt fp16", "tensorrt bf16", "tensorrt fp32", "cuda fp32", "cpu fp32"]
        );
        assert_eq!(names(machine(OPENVINO, true).backends(None, None, true)), ["openvino int8", "cpu int8"]);
    }

    #[test]
    fn what_is_asked_for_is_the_only_choice() {
        let here = machine(OPENVINO, true);
        assert_eq!(names(here.backends(Some(Provider::Cpu), None, false)), ["cpu fp32"]);
        assert_eq!(names(here.backends(Some(Provider::OpenVino), Some(Precision::Fp32), false)), ["openvino fp32"]);
        assert_eq!(names(here.backends(None, Some(Precision::Bf16), false)), ["openvino bf16"]);
        assert_eq!(names(here.backends(None, Some(Precision::Fp32), false)), ["openvino fp32", "cpu fp32"]);
        assert_eq!(names(here.backends(None, Some(Precision::Int8), true)), ["openvino int8", "cpu int8"]);
    }

    #[test]
    fn what_cannot_be_had_is_refused_with_what_can() {
        let here = machine(OPENVINO, false);
        let said = |provider, precision, is_int8| here.backends(provider, precision, is_int8).unwrap_err().to_string();
        let cuda = said(Some(Provider::Cuda), None, false);
        assert!(cuda.contains("no provider `cuda`, it has openvino, cpu"), "{cuda}");
        let bf16 = said(Some(Provider::OpenVino), Some(Precision::Bf16), false);
        assert!(bf16.contains("does not compute in bf16") && bf16.contains("fp32"), "{bf16}");
        assert!(said(None, Some(Precision::Fp16), false).contains("fp16"));
        assert!(said(None, Some(Precision::Int8), false).contains("export --precision int8"));
        assert!(said(None, Some(Precision::Bf16), true).contains("int8 model"));
    }

    #[test]
    fn names_are_read_as_written() {
        for provider in Provider::FASTEST_FIRST {
            assert_eq!(provider.name().parse(), Ok(provider));
        }
        for precision in Precision::ALL {
            assert_eq!(precision.name().parse(), Ok(precision));
        }
        assert!("gpu".parse::<Provider>().is_err());
        assert_eq!("auto".parse(), Ok(Choice::<Provider>(None)));
        assert_eq!("cuda".parse(), Ok(Choice(Some(Provider::Cuda))));
    }
}

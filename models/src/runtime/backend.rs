use std::fmt;
use std::str::FromStr;

use ort::ep::{self, ArbitrarilyConfigurableExecutionProvider, ExecutionProvider, ExecutionProviderDispatch};
use thiserror::Error;

/// An execution provider of ONNX Runtime.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Provider {
    /// ONNX Runtime's own kernels.
    Cpu,
    /// OpenVINO on the CPU.
    OpenVino,
    /// CUDA on an NVIDIA GPU.
    Cuda,
    /// TensorRT on an NVIDIA GPU, with an engine that is built when the model is loaded.
    TensorRt,
}

/// Numeric precision of inference. Sums are always accumulated in at least f32.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Precision {
    /// 32 bits.
    Fp32,
    /// 16 bits with the range of f32 and three significant digits.
    Bf16,
    /// 16 bits, up to 65504, with four significant digits.
    Fp16,
    /// 8 bits, with the scales in the file (`grasp-train export --precision int8`).
    Int8,
}

/// A provider and a precision.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Backend {
    /// Provider.
    pub provider: Provider,
    /// Precision.
    pub precision: Precision,
    /// Whether the kernels of one run are launched together, as a CUDA graph.
    pub cuda_graph: bool,
}

/// Why the requested backend cannot run a network.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum BackendError {
    /// The library was built without the provider.
    #[error(
        "provider `{wanted}` not found in this ONNX Runtime; available: {}; set ORT_DYLIB_PATH to a build that has it \
         (Python wheels onnxruntime-openvino, onnxruntime-gpu)",
        list(available)
    )]
    Provider {
        /// The requested value.
        wanted: Provider,
        /// The available providers.
        available: Vec<Provider>,
    },
    /// The provider does not support the precision on this machine.
    #[error("provider `{provider}` does not support {wanted} on this machine; available: {}", list(available))]
    Precision {
        /// The provider.
        provider: Provider,
        /// The requested value.
        wanted: Precision,
        /// The available precisions.
        available: Vec<Precision>,
    },
    /// The file has no scales for 8 bits.
    #[error("the model is not an int8 model; convert it with `grasp-train export --precision int8`")]
    NotInt8,
    /// The graph cannot be converted to fp16.
    #[error("the model cannot run in fp16: {0}; use fp32")]
    Half(String),
    /// An int8 file cannot run in another precision.
    #[error("the model is an int8 model and cannot run in {0}; serve the file that it was exported from")]
    Int8(Precision),
}

/// The providers of the library and the precisions of the machine.
#[derive(Clone, Debug)]
pub(crate) struct AvailableBackends {
    /// Providers in the order in which they are tried, fastest first.
    pub providers: Vec<Provider>,
    /// Whether the CPU has bf16 instructions.
    pub bf16: bool,
}

impl AvailableBackends {
    /// Detects providers and precisions. The library lists the providers that it was built with. Whether there is a GPU
    /// is only known when a session is created.
    pub fn here() -> Self {
        let providers = Provider::FASTEST_FIRST.into_iter().filter(|provider| provider.is_available()).collect();
        Self { providers, bf16: has_bf16() }
    }

    /// The backends to try for a model, in order. An explicit choice is the only one.
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
            Some(wanted) => return Err(BackendError::Provider { wanted, available: self.providers.clone() }),
        };
        let of = |provider| {
            let precisions = if is_int8 { vec![Precision::Int8] } else { self.precisions(provider) };
            precisions.into_iter().map(move |precision| Backend { provider, precision, cuda_graph: false })
        };
        let all: Vec<Backend> = providers.into_iter().flat_map(of).collect();
        let Some(wanted) = precision else { return Ok(all) };
        let fitting: Vec<Backend> = all.iter().copied().filter(|backend| backend.precision == wanted).collect();
        match (fitting.is_empty(), all.last()) {
            (true, Some(&Backend { provider, .. })) => {
                Err(BackendError::Precision { provider, wanted, available: self.precisions(provider) })
            }
            _ => Ok(fitting),
        }
    }

    /// Precisions of a provider, fastest first.
    fn precisions(&self, provider: Provider) -> Vec<Precision> {
        match provider {
            Provider::TensorRt => vec![Precision::Fp16, Precision::Bf16, Precision::Fp32],
            Provider::OpenVino if self.bf16 => vec![Precision::Bf16, Precision::Fp32],
            // One volume is faster in fp32, which uses TF32, on an H200; batches of a transformer in fp16.
            Provider::Cuda => vec![Precision::Fp32, Precision::Fp16],
            Provider::Cpu | Provider::OpenVino => vec![Precision::Fp32],
        }
    }
}

/// Whether the CPU has AVX-512 BF16, as every CPU with AMX. Without it OpenVINO ignores the bf16 hint and computes in f32.
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

    /// Name in options and responses.
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

    /// Name in options and responses.
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
    /// ONNX Runtime's CPU kernels in f32: the reference for all other backends.
    pub const REFERENCE: Self = Self { provider: Provider::Cpu, precision: Precision::Fp32, cuda_graph: false };

    /// This backend, before it with a CUDA graph where the provider has them.
    pub(crate) fn and_with_cuda_graph(self) -> impl Iterator<Item = Self> {
        let graph = (self.provider == Provider::Cuda).then_some(Self { cuda_graph: true, ..self });
        graph.into_iter().chain([self])
    }

    /// The provider to register with a session of `threads` threads. A failed registration is an error; the default
    /// of ONNX Runtime is to use the CPU without an error.
    pub(crate) fn dispatch(self, threads: usize) -> Option<ExecutionProviderDispatch> {
        let provider = match self.provider {
            Provider::Cpu => return None,
            Provider::OpenVino => {
                let hint = if self.precision == Precision::Fp32 { "f32" } else { "bf16" };
                // Without pinning: OpenVINO binds the threads of every session, and of every process, to the same CPUs.
                let config = format!(
                    r#"{{"CPU":{{"INFERENCE_PRECISION_HINT":"{hint}","INFERENCE_NUM_THREADS":"{threads}",
                        "NUM_STREAMS":"1","ENABLE_CPU_PINNING":false}}}}"#
                );
                let provider = ep::OpenVINO::default().with_device_type("CPU").with_precision("ACCURACY");
                provider.with_arbitrary_config("load_config", config).build()
            }
            Provider::Cuda => ep::CUDA::default().with_cuda_graph(self.cuda_graph).build(),
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

/// An explicit choice, or `auto` (`None`).
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
        write!(f, "{} {}{}", self.provider, self.precision, if self.cuda_graph { " with CUDA graphs" } else { "" })
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

/// The name is unknown.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq)]
#[error("must be {0}")]
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

    fn machine(providers: &[Provider], bf16: bool) -> AvailableBackends {
        AvailableBackends { providers: providers.to_vec(), bf16 }
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
            ["tensorrt fp16", "tensorrt bf16", "tensorrt fp32", "cuda fp32", "cuda fp16", "cpu fp32"]
        );
        assert_eq!(names(machine(OPENVINO, true).backends(None, None, true)), ["openvino int8", "cpu int8"]);
    }

    #[test]
    fn cuda_graphs_are_tried_first_where_there_are_any() {
        let names = |provider| {
            let backend = Backend { provider, ..Backend::REFERENCE };
            backend.and_with_cuda_graph().map(|backend| backend.to_string()).collect::<Vec<_>>()
        };
        assert_eq!(names(Provider::Cuda), ["cuda fp32 with CUDA graphs", "cuda fp32"]);
        assert_eq!(names(Provider::OpenVino), ["openvino fp32"]);
    }

    #[test]
    fn an_explicit_choice_is_the_only_one() {
        let here = machine(OPENVINO, true);
        assert_eq!(names(here.backends(Some(Provider::Cpu), None, false)), ["cpu fp32"]);
        assert_eq!(names(here.backends(Some(Provider::OpenVino), Some(Precision::Fp32), false)), ["openvino fp32"]);
        assert_eq!(names(here.backends(None, Some(Precision::Bf16), false)), ["openvino bf16"]);
        assert_eq!(names(here.backends(None, Some(Precision::Fp32), false)), ["openvino fp32", "cpu fp32"]);
        assert_eq!(names(here.backends(None, Some(Precision::Int8), true)), ["openvino int8", "cpu int8"]);
    }

    #[test]
    fn unavailable_backends_are_refused_with_the_available_ones() {
        let here = machine(OPENVINO, false);
        let message =
            |provider, precision, is_int8| here.backends(provider, precision, is_int8).unwrap_err().to_string();
        let cuda = message(Some(Provider::Cuda), None, false);
        assert!(cuda.contains("provider `cuda` not found in this ONNX Runtime; available: openvino, cpu"), "{cuda}");
        let bf16 = message(Some(Provider::OpenVino), Some(Precision::Bf16), false);
        assert!(bf16.contains("does not support bf16") && bf16.contains("fp32"), "{bf16}");
        assert!(message(None, Some(Precision::Fp16), false).contains("fp16"));
        assert!(message(None, Some(Precision::Int8), false).contains("export --precision int8"));
        assert!(message(None, Some(Precision::Bf16), true).contains("int8 model"));
    }

    #[test]
    fn names_round_trip() {
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

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use grasp::Volume;
use grasp_models::{INPUT, OUTPUTS};
use grasp_planner::Source;
use grasp_proto::oip::grpc_inference_service_server::GrpcInferenceService;
use grasp_proto::oip::model_infer_response::InferOutputTensor;
use grasp_proto::oip::model_metadata_response::TensorMetadata;
use grasp_proto::oip::repository_index_response::ModelIndex;
use grasp_proto::oip::{self, infer_parameter::ParameterChoice};
use grasp_proto::{FieldError, Priority, on_a_line};
use nalgebra::Isometry3;
use prost::bytes::Bytes;
use tokio::task::spawn_blocking;
use tonic::{Request, Response, Status};

use crate::readiness::State;
use crate::rpc::call::{Call, CallContext, Calls};
use crate::rpc::grasp_service::blocking;
use crate::rpc::infer_request::{FP32, batch, check_parameters};
use crate::rpc::pending;
use crate::serving::control::{Change, ModelControl};
use crate::serving::engine::Engine;
use crate::serving::job::{EngineError, Reply, Tensors};
use crate::serving::queue::Ticket;
use crate::serving::refusal::Refusal;
use crate::serving::registry::{ModelRegistry, Unavailable};
use crate::serving::turns::Turns;
use crate::telemetry::metrics::Metrics;
use crate::telemetry::timings::StageTimings;
use crate::transport::response_buffer::{ResponseBuffer, ResponsePermit};

/// Maximum number of volumes per request.
const MAX_BATCH: usize = 64;

/// Bytes of the maps per voxel: six f32.
const MAPS_PER_VOXEL: usize = 24;

/// The Open Inference Protocol: a network's raw input and output, for generic inference clients.
#[derive(Clone)]
pub(crate) struct InferenceRpc {
    models: Arc<ModelRegistry>,
    calls: Calls,
    metrics: Arc<Metrics>,
    control: ModelControl,
    /// The requests that are converted.
    conversions: Arc<Turns>,
    /// Limits the memory of maps, which are a hundred times as large as the grasps in them.
    response_buffer: ResponseBuffer,
}

impl InferenceRpc {
    pub fn new(
        models: Arc<ModelRegistry>,
        calls: Calls,
        metrics: Arc<Metrics>,
        control: ModelControl,
        conversions: Arc<Turns>,
    ) -> Self {
        Self { models, calls, metrics, control, conversions, response_buffer: ResponseBuffer::new() }
    }

    fn is_ready(&self) -> bool {
        *self.calls.state().borrow() == State::Ready
    }

    /// The network with this name, which is in the field `field`, and version. Planners without a network are not found.
    fn network(&self, field: &'static str, name: &str, version: &str) -> Result<Arc<Engine>, Refusal> {
        self.calls.check_started()?;
        let requested = || on_a_line(format!("{name} {version}").trim_end());
        let networks = || {
            let served = self.models.now();
            let names = served.iter().filter(|engine| engine.source.network().is_some());
            names.map(|engine| engine.label.clone()).collect::<Vec<_>>().join(", ")
        };
        let unknown = || Refusal::UnknownModel { field, requested: requested(), available: networks() };
        if name.is_empty() {
            return Err(unknown());
        }
        let engine = self.models.select(name, version, None).map_err(|_| unknown())?;
        if engine.source.network().is_some() { Ok(engine) } else { Err(unknown()) }
    }

    /// Changes a model of the folder.
    async fn change(
        &self,
        repository: &str,
        parameters: &HashMap<String, oip::ModelRepositoryParameter>,
        name: String,
        change: Change,
    ) -> Result<(), Refusal> {
        self.calls.check_started()?;
        one_repository(repository)?;
        if let Some(parameter) = parameters.keys().min() {
            let value = format_args!("`{}`", on_a_line(parameter));
            return Err(FieldError::new("parameters", value, "must be empty").into());
        }
        self.control.change(name, change).await
    }

    /// Numbers and durations of a model's inferences.
    fn statistics(&self, engine: &Engine) -> oip::ModelStatistics {
        let duration = |count: u64, seconds: f64| {
            let ns = u64::try_from(Duration::from_secs_f64(seconds).as_nanos()).unwrap_or(u64::MAX);
            Some(oip::StatisticDuration { count, ns })
        };
        let stage = |name: &str| {
            let (count, seconds) = self.metrics.stage(&engine.label, name);
            duration(count, seconds)
        };
        // As compute_output of Triton: all work on the outputs of the network.
        let (count, decoding) = self.metrics.stage(&engine.label, "postprocessing");
        let is_evaluated = matches!(engine.source, Source::Evaluated { .. });
        let evaluation = if is_evaluated { self.metrics.stage(&engine.label, "evaluation").1 } else { 0.0 };
        let output = duration(count, decoding + evaluation);
        let (batches, volumes) = self.metrics.batches(&engine.label);
        oip::ModelStatistics {
            name: engine.source.name().to_owned(),
            version: engine.source.version().to_owned(),
            last_inference: engine.latest_inference(),
            inference_count: volumes,
            execution_count: batches,
            inference_stats: Some(oip::InferStatistics {
                success: stage("total"),
                fail: duration(self.metrics.failures(&engine.label), 0.0),
                queue: stage("queue"),
                compute_input: stage("preprocessing"),
                compute_infer: stage("inference"),
                compute_output: output,
            }),
        }
    }

    /// Validates a request and queues each of its volumes.
    async fn submit(&self, request: oip::ModelInferRequest, call: &mut Call) -> Result<Queued, Refusal> {
        check_parameters(&request)?;
        let engine = self.network("model_name", &request.model_name, &request.model_version)?;
        call.set_model(&engine);
        for output in &request.outputs {
            if !OUTPUTS.iter().any(|(name, _)| *name == output.name) {
                let needed = "must be quality, rotation or width";
                return Err(FieldError::new("outputs", format_args!("`{}`", output.name), needed).into());
            }
        }
        let ticket = call.ticket(Priority::Normal);
        engine.check_capacity(1, ticket)?;
        let (turn, waited) = self.conversions.of_request(&engine, ticket).await?;
        let (selected, buffer) = (Arc::clone(&engine), self.response_buffer.clone());
        let converted = blocking(turn, call.deadline, move |_| convert(request, &selected, ticket, &buffer));
        let Converted { request, volumes, permit } = converted.await?;
        let replies = engine.maps(volumes, ticket, call.span())?;
        Ok(Queued { engine, request, replies, waited, permit })
    }
}

/// The queued volumes of a request.
struct Queued {
    engine: Arc<Engine>,
    /// Without the values of its input.
    request: oip::ModelInferRequest,
    replies: Vec<Reply<Tensors>>,
    /// The time that the request waited for its conversion.
    waited: Duration,
    permit: ResponsePermit,
}

struct Converted {
    request: oip::ModelInferRequest,
    volumes: Vec<Volume>,
    permit: ResponsePermit,
}

/// Validates the volumes of a request, and reserves the memory of its response.
fn convert(
    mut request: oip::ModelInferRequest,
    engine: &Engine,
    ticket: Ticket,
    buffer: &ResponseBuffer,
) -> Result<Converted, Refusal> {
    let network = engine.source.network().map(|entry| &entry.metadata);
    let (n, voxel_size) = network.map_or((0, 0.0), |metadata| (metadata.resolution, metadata.voxel_size));
    let (count, values) = batch(&request, n, max_batch(engine))?;
    engine.check_capacity(count, ticket)?;
    let permit = buffer.acquire(count * n.pow(3) * MAPS_PER_VOXEL).ok_or_else(|| {
        let capacity = ResponseBuffer::CAPACITY >> 20;
        engine.overloaded(format!("the buffer of unread ModelInfer responses is full ({capacity} MiB)"))
    })?;
    let volume = |values: Vec<f32>| {
        let volume = Volume::new(n, voxel_size, Isometry3::identity(), values);
        volume.map_err(|error| {
            Refusal::from(FieldError { field: "inputs[0]".into(), message: format!("inputs[0]: {error}") })
        })
    };
    let volumes = values.volumes(n.pow(3)).map(volume).collect::<Result<_, _>>()?;
    (request.inputs, request.raw_input_contents) = (Vec::new(), Vec::new());
    Ok(Converted { request, volumes, permit })
}

fn one_repository(name: &str) -> Result<(), FieldError> {
    if name.is_empty() {
        return Ok(());
    }
    Err(FieldError::new("repository_name", format_args!("`{}`", on_a_line(name)), "must be empty"))
}

/// The response: the maps of all volumes, concatenated to one tensor per requested output.
fn response(
    request: oip::ModelInferRequest,
    engine: &Engine,
    maps: &[Tensors],
    timings: &StageTimings,
) -> oip::ModelInferResponse {
    let n = edge(engine);
    let mut outputs = Vec::new();
    let mut raw_output_contents = Vec::new();
    for (index, (name, channels)) in OUTPUTS.into_iter().enumerate() {
        if !request.outputs.is_empty() && !request.outputs.iter().any(|output| output.name == name) {
            continue;
        }
        let parts = maps.iter().map(|Tensors(outputs)| &*outputs[index]);
        let shape = vec![maps.len() as i64, channels as i64, n, n, n];
        outputs.push(InferOutputTensor {
            name: name.to_owned(),
            datatype: FP32.to_owned(),
            shape,
            ..Default::default()
        });
        raw_output_contents.push(Bytes::from(parts.collect::<Vec<_>>().concat()));
    }
    let parameters = timings.stages().map(|(stage, seconds)| {
        let parameter = oip::InferParameter { parameter_choice: Some(ParameterChoice::DoubleParam(seconds)) };
        (format!("{stage}_seconds"), parameter)
    });
    oip::ModelInferResponse {
        model_name: engine.source.name().to_owned(),
        model_version: engine.source.version().to_owned(),
        id: request.id,
        parameters: parameters.collect(),
        outputs,
        raw_output_contents,
    }
}

#[tonic::async_trait]
impl GrpcInferenceService for InferenceRpc {
    async fn server_live(
        &self,
        _: Request<oip::ServerLiveRequest>,
    ) -> Result<Response<oip::ServerLiveResponse>, Status> {
        let live = *self.calls.state().borrow() != State::Unable;
        Ok(Response::new(oip::ServerLiveResponse { live }))
    }

    async fn server_ready(
        &self,
        _: Request<oip::ServerReadyRequest>,
    ) -> Result<Response<oip::ServerReadyResponse>, Status> {
        Ok(Response::new(oip::ServerReadyResponse { ready: self.is_ready() }))
    }

    async fn model_ready(
        &self,
        request: Request<oip::ModelReadyRequest>,
    ) -> Result<Response<oip::ModelReadyResponse>, Status> {
        let oip::ModelReadyRequest { name, version } = request.into_inner();
        let ready = self.is_ready() && self.network("name", &name, &version).is_ok();
        Ok(Response::new(oip::ModelReadyResponse { ready }))
    }

    async fn server_metadata(
        &self,
        _: Request<oip::ServerMetadataRequest>,
    ) -> Result<Response<oip::ServerMetadataResponse>, Status> {
        Ok(Response::new(oip::ServerMetadataResponse {
            name: env!("CARGO_PKG_NAME").to_owned(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            extensions: EXTENSIONS.map(str::to_owned).into(),
        }))
    }

    async fn model_metadata(
        &self,
        request: Request<oip::ModelMetadataRequest>,
    ) -> Result<Response<oip::ModelMetadataResponse>, Status> {
        let oip::ModelMetadataRequest { name, version } = request.into_inner();
        let engine = self.network("name", &name, &version).map_err(|refusal| refusal.status(""))?;
        let tensor = |name: &str, channels: usize| {
            let edge = edge(&engine);
            let shape = vec![-1, channels as i64, edge, edge, edge];
            TensorMetadata { name: name.to_owned(), datatype: FP32.to_owned(), shape }
        };
        let served = self.models.now();
        let versions = served.iter().filter(|other| other.source.name() == engine.source.name());
        Ok(Response::new(oip::ModelMetadataResponse {
            name: engine.source.name().to_owned(),
            versions: versions.map(|engine| engine.source.version().to_owned()).collect(),
            platform: PLATFORM.to_owned(),
            inputs: vec![tensor(INPUT, 1)],
            outputs: OUTPUTS.into_iter().map(|(name, channels)| tensor(name, channels)).collect(),
        }))
    }

    async fn model_infer(
        &self,
        request: Request<oip::ModelInferRequest>,
    ) -> Result<Response<oip::ModelInferResponse>, Status> {
        let context = CallContext::of(&request);
        let request = request.into_inner();
        let (mut call, checked) = self.calls.open_with("id", request.id.clone(), context);
        let id = call.id.clone();
        let queued = match checked {
            Ok(()) => self.submit(request, &mut call).await,
            Err(refusal) => Err(refusal),
        };
        let outcome = match queued {
            Ok(Queued { engine, request, replies, waited, permit }) => {
                let maps = pending::maps(&mut call, replies, waited).await;
                maps.map(|(maps, timings)| (engine, request, maps, timings, permit))
            }
            Err(refusal) => Err(refusal),
        };
        let (engine, request, maps, timings, permit) = outcome.map_err(|refusal| call.end(refusal).status(&id))?;
        // Copies megabytes.
        let copied = spawn_blocking(move || response(request, &engine, &maps, &timings)).await;
        let copied = copied.map_err(|panic| Refusal::from(EngineError::Panic(panic.to_string())).status(&id))?;
        let mut response = Response::new(copied);
        response.extensions_mut().insert(permit);
        Ok(response)
    }

    async fn model_config(
        &self,
        request: Request<oip::ModelConfigRequest>,
    ) -> Result<Response<oip::ModelConfigResponse>, Status> {
        let oip::ModelConfigRequest { name, version } = request.into_inner();
        let engine = self.network("name", &name, &version).map_err(|refusal| refusal.status(""))?;
        let edge = edge(&engine);
        let (data_type, dims) =
            (oip::DataType::TypeFp32.into(), |channels: usize| vec![channels as i64, edge, edge, edge]);
        let output = |(name, channels): (&str, usize)| oip::ModelOutput {
            name: name.to_owned(),
            data_type,
            dims: dims(channels),
        };
        Ok(Response::new(oip::ModelConfigResponse {
            config: Some(oip::ModelConfig {
                name: engine.source.name().to_owned(),
                platform: PLATFORM.to_owned(),
                backend: "onnxruntime".to_owned(),
                max_batch_size: max_batch(&engine) as i32,
                input: vec![oip::ModelInput { name: INPUT.to_owned(), data_type, dims: dims(1) }],
                output: OUTPUTS.into_iter().map(output).collect(),
            }),
        }))
    }

    async fn model_statistics(
        &self,
        request: Request<oip::ModelStatisticsRequest>,
    ) -> Result<Response<oip::ModelStatisticsResponse>, Status> {
        let oip::ModelStatisticsRequest { name, version } = request.into_inner();
        self.calls.check_started().map_err(|refusal| refusal.status(""))?;
        let served = self.models.now();
        let is_requested = |engine: &&Arc<Engine>| {
            engine.source.network().is_some()
                && (name.is_empty() || engine.source.name() == name)
                && (version.is_empty() || engine.source.version() == version)
        };
        if !name.is_empty() {
            self.network("name", &name, &version).map_err(|refusal| refusal.status(""))?;
        }
        let model_stats = served.iter().filter(is_requested).map(|engine| self.statistics(engine)).collect();
        Ok(Response::new(oip::ModelStatisticsResponse { model_stats }))
    }

    async fn repository_index(
        &self,
        request: Request<oip::RepositoryIndexRequest>,
    ) -> Result<Response<oip::RepositoryIndexResponse>, Status> {
        let oip::RepositoryIndexRequest { repository_name, ready } = request.into_inner();
        one_repository(&repository_name).map_err(|error| Refusal::from(error).status(""))?;
        self.calls.check_started().map_err(|refusal| refusal.status(""))?;
        let served = self.models.now();
        let networks = served.iter().filter(|engine| engine.source.network().is_some());
        let mut models: Vec<_> = networks
            .map(|engine| ModelIndex {
                name: engine.source.name().to_owned(),
                version: engine.source.version().to_owned(),
                state: "READY".to_owned(),
                reason: String::new(),
            })
            .collect();
        if !ready {
            models.extend(self.models.unavailable().into_iter().map(|Unavailable { name, reason }| ModelIndex {
                name,
                version: String::new(),
                state: "UNAVAILABLE".to_owned(),
                reason,
            }));
        }
        Ok(Response::new(oip::RepositoryIndexResponse { models }))
    }

    async fn repository_model_load(
        &self,
        request: Request<oip::RepositoryModelLoadRequest>,
    ) -> Result<Response<oip::RepositoryModelLoadResponse>, Status> {
        let oip::RepositoryModelLoadRequest { repository_name, model_name, parameters } = request.into_inner();
        let changed = self.change(&repository_name, &parameters, model_name, Change::Load).await;
        changed.map_err(|refusal| refusal.status(""))?;
        Ok(Response::new(oip::RepositoryModelLoadResponse {}))
    }

    async fn repository_model_unload(
        &self,
        request: Request<oip::RepositoryModelUnloadRequest>,
    ) -> Result<Response<oip::RepositoryModelUnloadResponse>, Status> {
        let oip::RepositoryModelUnloadRequest { repository_name, model_name, mut parameters } = request.into_inner();
        // Triton's client always sends it. No other model depends on an unloaded one.
        parameters.remove("unload_dependents");
        let changed = self.change(&repository_name, &parameters, model_name, Change::Unload).await;
        changed.map_err(|refusal| refusal.status(""))?;
        Ok(Response::new(oip::RepositoryModelUnloadResponse {}))
    }
}

/// The extensions of the protocol, by Triton's names.
const EXTENSIONS: [&str; 4] = ["binary_tensor_data", "model_configuration", "model_repository", "statistics"];

/// Triton's platform name for ONNX Runtime.
const PLATFORM: &str = "onnxruntime_onnx";

/// Resolution of a network's input, voxels along an edge.
fn edge(engine: &Engine) -> i64 {
    engine.source.network().map_or(0, |entry| entry.metadata.resolution as i64)
}

/// Maximum number of volumes per request: all of them must fit into the queue, and their maps into the response buffer.
fn max_batch(engine: &Engine) -> usize {
    let maps = (edge(engine) as usize).pow(3) * MAPS_PER_VOXEL;
    MAX_BATCH.min(engine.capacity()).min(ResponseBuffer::CAPACITY / maps.max(1))
}

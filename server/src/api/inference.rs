//! The Open Inference Protocol.

mod infer_request;

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use ::grasp::{Code, Priority, RequestError, Volume, on_a_line};
use grasp_engine::{
    Change, FairSemaphore, Model, ModelControl, ModelRegistry, Reply, RequestMetadata, SessionOutput, StageTimings,
    Tensors, Totals, Unavailable,
};
use grasp_models::{INPUT, OUTPUTS};
use grasp_proto::oip::grpc_inference_service_server::GrpcInferenceService;
use grasp_proto::oip::model_infer_response::InferOutputTensor;
use grasp_proto::oip::model_metadata_response::TensorMetadata;
use grasp_proto::oip::repository_index_response::ModelIndex;
use grasp_proto::oip::{self, infer_parameter::ParameterChoice};
use nalgebra::Isometry3;
use prost::bytes::Bytes;
use tokio::task::spawn_blocking;
use tonic::{Request, Response, Status};

use crate::api::blocking::blocking;
use crate::api::call::{Call, CallContext, Calls};
use crate::api::grasp::outputs;
use crate::api::status::status;
use crate::readiness::State;
use crate::telemetry::recent::Outcome;
use crate::telemetry::recorder::Recording;
use crate::transport::response_buffer::{ResponseBuffer, ResponsePermit};
use infer_request::{FP32, batch, check_parameters};

/// Maximum number of volumes per request.
const MAX_BATCH: usize = 64;

/// Bytes of the maps per voxel: six f32.
const MAPS_PER_VOXEL: usize = 24;

/// The Open Inference Protocol: a network's raw input and output, for generic inference clients.
#[derive(Clone)]
pub(crate) struct InferenceApi {
    models: Arc<ModelRegistry>,
    calls: Calls,
    control: ModelControl,
    /// Permits of the requests that are converted.
    conversions: FairSemaphore,
    /// Limits the memory of maps, which are a hundred times as large as the grasps decoded from them.
    response_buffer: ResponseBuffer,
}

impl InferenceApi {
    pub fn new(models: Arc<ModelRegistry>, calls: Calls, control: ModelControl, conversions: FairSemaphore) -> Self {
        Self { models, calls, control, conversions, response_buffer: ResponseBuffer::new() }
    }

    fn is_ready(&self) -> bool {
        *self.calls.state().borrow() == State::Ready
    }

    /// The network with this name and version; `field` of the request has the name. Planners without a network are not
    /// found.
    fn network(&self, field: &'static str, name: &str, version: &str) -> Result<Arc<Model>, RequestError> {
        self.calls.check_started()?;
        self.models.network(field, name, version)
    }

    /// Changes a model of the folder.
    async fn change(
        &self,
        repository: &str,
        parameters: &HashMap<String, oip::ModelRepositoryParameter>,
        name: String,
        change: Change,
    ) -> Result<(), RequestError> {
        self.calls.check_started()?;
        one_repository(repository)?;
        if let Some(parameter) = parameters.keys().min() {
            let value = format_args!("`{}`", on_a_line(parameter));
            return Err(RequestError::invalid("parameters", value, "must be empty"));
        }
        self.control.change(name, change).await
    }

    /// Runs the network on the volumes of a request.
    async fn infer(
        &self,
        request: oip::ModelInferRequest,
        call: &mut Call,
    ) -> Result<(oip::ModelInferResponse, Outcome, ResponsePermit), RequestError> {
        let Queued { model, request, replies, waited, permit } = self.submit(request, call).await?;
        let preprocessing = call.elapsed().saturating_sub(waited);
        let mut maps = Vec::with_capacity(replies.len());
        // Those of the slowest volume.
        let mut timings = StageTimings { preprocessing, ..StageTimings::default() };
        for SessionOutput { value, queue, inference, postprocessing, .. } in outputs(replies, call.deadline).await? {
            maps.push(value);
            if queue + inference >= timings.queue + timings.inference {
                timings = StageTimings { queue, inference, postprocessing, ..timings };
            }
        }
        timings.queue += waited;
        timings.total = call.elapsed();
        // Copies megabytes, which would block a thread of the async runtime.
        let copied = spawn_blocking(move || response(request, &model, &maps, &timings)).await;
        let failed = |panic| RequestError::new(Code::Internal, format!("copying the maps panicked: {panic}"));
        Ok((copied.map_err(failed)?, Outcome::Inferred(timings), permit))
    }

    /// Validates a request and queues each of its volumes.
    async fn submit(&self, request: oip::ModelInferRequest, call: &mut Call) -> Result<Queued, RequestError> {
        check_parameters(&request)?;
        let model = self.network("model_name", &request.model_name, &request.model_version)?;
        call.set_model(&model);
        for output in &request.outputs {
            if !OUTPUTS.iter().any(|(name, _)| *name == output.name) {
                let needed = "must be quality, rotation or width";
                return Err(RequestError::invalid("outputs", format_args!("`{}`", output.name), needed));
            }
        }
        let metadata = call.metadata(Priority::Normal);
        model.check_capacity(1, metadata)?;
        let (turn, waited) = self.conversions.acquire(&model, metadata).await?;
        let (selected, buffer) = (Arc::clone(&model), self.response_buffer.clone());
        let converted = blocking(turn, call.deadline, move |_| convert(request, &selected, metadata, &buffer));
        let Converted { request, volumes, permit } = converted.await?;
        let replies = model.maps(volumes, metadata, call.span())?;
        Ok(Queued { model, request, replies, waited, permit })
    }
}

/// Numbers and durations of a model's inferences.
fn statistics(model: &Model) -> oip::ModelStatistics {
    let Totals { succeeded, failed, batches, volumes, queue, preprocessing, inference, output, total } =
        model.statistics.totals();
    let duration = |count: u64, sum: Duration| {
        Some(oip::StatisticDuration { count, ns: u64::try_from(sum.as_nanos()).unwrap_or(u64::MAX) })
    };
    oip::ModelStatistics {
        name: model.spec.name().to_owned(),
        version: model.spec.version().to_owned(),
        last_inference: model.latest_inference(),
        inference_count: volumes,
        execution_count: batches,
        inference_stats: Some(oip::InferStatistics {
            success: duration(succeeded, total),
            fail: duration(failed, Duration::ZERO),
            queue: duration(succeeded, queue),
            compute_input: duration(succeeded, preprocessing),
            compute_infer: duration(succeeded, inference),
            // Like Triton's compute_output: all work on the outputs of the network.
            compute_output: duration(succeeded, output),
        }),
    }
}

/// The queued volumes of a request.
struct Queued {
    model: Arc<Model>,
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
    model: &Model,
    metadata: RequestMetadata,
    buffer: &ResponseBuffer,
) -> Result<Converted, RequestError> {
    let network = model.spec.network().map(|entry| &entry.metadata);
    let (n, voxel_size) = network.map_or((0, 0.0), |metadata| (metadata.resolution, metadata.voxel_size));
    let (count, values) = batch(&request, n, max_batch(model))?;
    model.check_capacity(count, metadata)?;
    let permit = buffer.acquire(count * n.pow(3) * MAPS_PER_VOXEL).ok_or_else(|| {
        let capacity = ResponseBuffer::CAPACITY >> 20;
        model.overloaded(&format!("the buffer of unread ModelInfer responses is full ({capacity} MiB)"))
    })?;
    let volume = |values: Vec<f32>| {
        let volume = Volume::new(n, voxel_size, Isometry3::identity(), values);
        volume.map_err(|error| RequestError::refused("inputs[0]", error))
    };
    let volumes = values.volumes(n.pow(3)).map(volume).collect::<Result<_, _>>()?;
    (request.inputs, request.raw_input_contents) = (Vec::new(), Vec::new());
    Ok(Converted { request, volumes, permit })
}

fn one_repository(name: &str) -> Result<(), RequestError> {
    if name.is_empty() {
        return Ok(());
    }
    Err(RequestError::invalid("repository_name", format_args!("`{}`", on_a_line(name)), "must be empty"))
}

/// The response: the maps of all volumes, concatenated into one tensor per requested output.
fn response(
    request: oip::ModelInferRequest,
    model: &Model,
    maps: &[Tensors],
    timings: &StageTimings,
) -> oip::ModelInferResponse {
    let n = edge(model);
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
        model_name: model.spec.name().to_owned(),
        model_version: model.spec.version().to_owned(),
        id: request.id,
        parameters: parameters.collect(),
        outputs,
        raw_output_contents,
    }
}

#[tonic::async_trait]
impl GrpcInferenceService for InferenceApi {
    async fn server_live(
        &self,
        _: Request<oip::ServerLiveRequest>,
    ) -> Result<Response<oip::ServerLiveResponse>, Status> {
        let live = *self.calls.state().borrow() != State::Unhealthy;
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
        let model = self.network("name", &name, &version).map_err(|error| status(&error, ""))?;
        let tensor = |name: &str, channels: usize| {
            let edge = edge(&model);
            let shape = vec![-1, channels as i64, edge, edge, edge];
            TensorMetadata { name: name.to_owned(), datatype: FP32.to_owned(), shape }
        };
        let served = self.models.now();
        let versions = served.iter().filter(|other| other.spec.name() == model.spec.name());
        Ok(Response::new(oip::ModelMetadataResponse {
            name: model.spec.name().to_owned(),
            versions: versions.map(|model| model.spec.version().to_owned()).collect(),
            platform: PLATFORM.to_owned(),
            inputs: vec![tensor(INPUT, 1)],
            outputs: OUTPUTS.into_iter().map(|(name, channels)| tensor(name, channels)).collect(),
        }))
    }

    async fn model_infer(
        &self,
        request: Request<oip::ModelInferRequest>,
    ) -> Result<Response<oip::ModelInferResponse>, Status> {
        let context = CallContext::new(&request).with_id_field("id");
        let request = request.into_inner();
        let id = request.id.clone();
        let mut permit = None;
        let work = async |call: &mut Call| {
            let (response, outcome, held) = self.infer(request, call).await?;
            permit = Some(held);
            Ok((response, Some(outcome)))
        };
        let answer = self.calls.run(id, context, Recording::none(), work).await;
        let mut response = answer.into_response()?;
        if let Some(permit) = permit {
            response.extensions_mut().insert(permit);
        }
        Ok(response)
    }

    async fn model_config(
        &self,
        request: Request<oip::ModelConfigRequest>,
    ) -> Result<Response<oip::ModelConfigResponse>, Status> {
        let oip::ModelConfigRequest { name, version } = request.into_inner();
        let model = self.network("name", &name, &version).map_err(|error| status(&error, ""))?;
        let edge = edge(&model);
        let (data_type, dims) =
            (oip::DataType::TypeFp32.into(), |channels: usize| vec![channels as i64, edge, edge, edge]);
        let output = |(name, channels): (&str, usize)| oip::ModelOutput {
            name: name.to_owned(),
            data_type,
            dims: dims(channels),
        };
        Ok(Response::new(oip::ModelConfigResponse {
            config: Some(oip::ModelConfig {
                name: model.spec.name().to_owned(),
                platform: PLATFORM.to_owned(),
                backend: "onnxruntime".to_owned(),
                max_batch_size: max_batch(&model) as i32,
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
        self.calls.check_started().map_err(|error| status(&error, ""))?;
        let served = self.models.now();
        let name = ModelRegistry::current_name(&served, &name);
        let is_requested = |model: &&Arc<Model>| {
            model.spec.network().is_some()
                && (name.is_empty() || model.spec.name() == name)
                && (version.is_empty() || model.spec.version() == version)
        };
        if !name.is_empty() {
            self.network("name", name, &version).map_err(|error| status(&error, ""))?;
        }
        let model_stats = served.iter().filter(is_requested).map(|model| statistics(model)).collect();
        Ok(Response::new(oip::ModelStatisticsResponse { model_stats }))
    }

    async fn repository_index(
        &self,
        request: Request<oip::RepositoryIndexRequest>,
    ) -> Result<Response<oip::RepositoryIndexResponse>, Status> {
        let oip::RepositoryIndexRequest { repository_name, ready } = request.into_inner();
        one_repository(&repository_name).map_err(|error| status(&error, ""))?;
        self.calls.check_started().map_err(|error| status(&error, ""))?;
        let served = self.models.now();
        let networks = served.iter().filter(|model| model.spec.network().is_some());
        let mut models: Vec<_> = networks
            .map(|model| ModelIndex {
                name: model.spec.name().to_owned(),
                version: model.spec.version().to_owned(),
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
        changed.map_err(|error| status(&error, ""))?;
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
        changed.map_err(|error| status(&error, ""))?;
        Ok(Response::new(oip::RepositoryModelUnloadResponse {}))
    }
}

/// The extensions of the protocol, by Triton's names.
const EXTENSIONS: [&str; 4] = ["binary_tensor_data", "model_configuration", "model_repository", "statistics"];

/// Triton's platform name for ONNX Runtime.
const PLATFORM: &str = "onnxruntime_onnx";

/// Resolution of a network's input, voxels along an edge.
fn edge(model: &Model) -> i64 {
    model.spec.network().map_or(0, |entry| entry.metadata.resolution as i64)
}

/// Maximum number of volumes per request: all of them must fit into the queue, and their maps into the response buffer.
fn max_batch(model: &Model) -> usize {
    let maps = (edge(model) as usize).pow(3) * MAPS_PER_VOXEL;
    MAX_BATCH.min(model.capacity()).min(ResponseBuffer::CAPACITY / maps.max(1))
}

//! Traces of requests, exported to an OpenTelemetry collector.

use std::collections::HashMap;
use std::net::SocketAddr;

use grasp_proto::encode;
use grasp_proto::pb::{DataType, DetectGraspsRequest, Options};
use grasp_tests::{RESOLUTION, Server, TestModel, blobs};
use nalgebra::Isometry3;
use opentelemetry_proto::tonic::collector::trace::v1::trace_service_server::{TraceService, TraceServiceServer};
use opentelemetry_proto::tonic::collector::trace::v1::{ExportTraceServiceRequest, ExportTraceServiceResponse};
use opentelemetry_proto::tonic::common::v1::any_value::Value;
use opentelemetry_proto::tonic::trace::v1::Span;
use tokio::net::TcpListener;
use tokio::sync::mpsc;
use tonic::transport::server::TcpIncoming;
use tonic::{Request, Response, Status};

/// An OTLP collector that forwards each export to a channel.
struct Collector(mpsc::Sender<ExportTraceServiceRequest>);

#[tonic::async_trait]
impl TraceService for Collector {
    async fn export(
        &self,
        request: Request<ExportTraceServiceRequest>,
    ) -> Result<Response<ExportTraceServiceResponse>, Status> {
        self.0.send(request.into_inner()).await.map_err(|_| Status::unavailable("the test is over"))?;
        Ok(Response::new(ExportTraceServiceResponse::default()))
    }
}

async fn collector() -> (SocketAddr, mpsc::Receiver<ExportTraceServiceRequest>) {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let (sender, exports) = mpsc::channel(16);
    let service = TraceServiceServer::new(Collector(sender));
    tokio::spawn(
        tonic::transport::Server::builder().add_service(service).serve_with_incoming(TcpIncoming::from(listener)),
    );
    (address, exports)
}

fn attributes(span: &Span) -> HashMap<&str, String> {
    let text = |value: &Value| match value {
        Value::StringValue(text) => text.clone(),
        Value::DoubleValue(number) => number.to_string(),
        other => format!("{other:?}"),
    };
    let pairs = span.attributes.iter();
    pairs.filter_map(|pair| Some((pair.key.as_str(), text(pair.value.as_ref()?.value.as_ref()?)))).collect()
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn the_spans_of_a_request_belong_to_the_trace_of_the_client() {
    let (address, mut exports) = collector().await;
    let mut server =
        Server::run(&[TestModel::new("mirror")], &["--otlp", &format!("http://{address}"), "--log", "error"]);
    let volume = encode(&blobs(RESOLUTION, Isometry3::identity(), &[[5, 5, 5]]), DataType::F32, "");
    let (trace, parent) = ("0af7651916cd43dd8448eb211c80319c", "b7ad6b7169203331");
    let message = |request_id: &str, model: &str| DetectGraspsRequest {
        request_id: request_id.to_owned(),
        volume: Some(volume.clone()),
        options: Some(Options { model: model.to_owned(), ..Options::default() }),
    };
    let mut client = server.raw().await;
    let mut request = Request::new(message("traced", ""));
    request.metadata_mut().insert("traceparent", format!("00-{trace}-{parent}-01").parse().unwrap());
    client.detect_grasps(request).await.unwrap();
    client.detect_grasps(message("alone", "unknown")).await.unwrap_err();
    // Remaining spans are exported before the exit.
    drop(client);
    server.terminate().unwrap();
    let ended = tokio::task::spawn_blocking(move || server.wait());
    assert!(ended.await.unwrap().unwrap().success());

    let mut spans = Vec::new();
    while let Ok(export) = exports.try_recv() {
        for resource in export.resource_spans {
            let service = resource.resource.unwrap().attributes.into_iter().find(|pair| pair.key == "service.name");
            let Some(Value::StringValue(name)) = service.unwrap().value.unwrap().value else { panic!() };
            assert_eq!(name, "graspd");
            spans.extend(resource.scope_spans.into_iter().flat_map(|scope| scope.spans));
        }
    }
    let request = |id: &str| {
        let is_it = |span: &&Span| span.name == "detect" && attributes(span)["request_id"] == id;
        spans.iter().find(is_it).unwrap_or_else(|| panic!("no span of {id}"))
    };
    let traced = request("traced");
    assert_eq!((hex(&traced.trace_id), hex(&traced.parent_span_id)), (trace.to_owned(), parent.to_owned()));
    // SPAN_KIND_SERVER.
    assert_eq!(traced.kind, 2);
    let values = attributes(traced);
    assert_eq!(values["model"], "mirror 1");
    assert!(values["total"].parse::<f64>().unwrap() > 0.0);
    let mut stages: Vec<_> = spans.iter().filter(|span| span.parent_span_id == traced.span_id).collect();
    stages.sort_by_key(|span| span.start_time_unix_nano);
    let names: Vec<_> = stages.iter().map(|span| span.name.as_str()).collect();
    assert_eq!(names, ["preprocessing", "queue", "inference", "postprocessing"]);
    assert!(stages.windows(2).all(|pair| pair[0].end_time_unix_nano <= pair[1].start_time_unix_nano));
    assert!(stages.iter().all(|span| span.trace_id == traced.trace_id));

    let alone = request("alone");
    assert!(alone.parent_span_id.is_empty() && alone.trace_id != traced.trace_id);
    assert!(!spans.iter().any(|span| span.parent_span_id == alone.span_id), "a refused request has no stages");
}

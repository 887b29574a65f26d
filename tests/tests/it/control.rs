//! Loading and unloading of models by clients, and their statistics.

use grasp_client::{DetectOptions, Options};
use grasp_proto::oip;
use grasp_proto::oip::grpc_inference_service_client::GrpcInferenceServiceClient;
use grasp_proto::oip::infer_parameter::ParameterChoice;
use grasp_proto::oip::model_repository_parameter::ParameterChoice as ModelChoice;
use grasp_tests::{RESOLUTION, Server, TestModel, blobs};
use nalgebra::Isometry3;
use tonic::transport::Channel;
use tonic::{Code, Status};

type Inference = GrpcInferenceServiceClient<Channel>;

async fn inference(server: &Server) -> Inference {
    GrpcInferenceServiceClient::new(server.channel().await)
}

async fn load(client: &mut Inference, name: &str) -> Result<(), Status> {
    let request = oip::RepositoryModelLoadRequest { model_name: name.to_owned(), ..Default::default() };
    client.repository_model_load(request).await.map(|_| ())
}

async fn unload(client: &mut Inference, name: &str) -> Result<(), Status> {
    // Triton's client sends this parameter always.
    let dependents = oip::ModelRepositoryParameter { parameter_choice: Some(ModelChoice::BoolParam(false)) };
    let parameters = [("unload_dependents".to_owned(), dependents)].into();
    let request = oip::RepositoryModelUnloadRequest { model_name: name.to_owned(), parameters, ..Default::default() };
    client.repository_model_unload(request).await.map(|_| ())
}

/// Name, version and state of each model of the folder.
async fn index(client: &mut Inference, ready: bool) -> Vec<String> {
    let request = oip::RepositoryIndexRequest { repository_name: String::new(), ready };
    let models = client.repository_index(request).await.unwrap().into_inner().models;
    models.into_iter().map(|model| format!("{} {} {}", model.name, model.version, model.state)).collect()
}

#[tokio::test]
async fn models_are_loaded_and_unloaded_where_it_is_allowed() {
    let server = Server::run(&[TestModel::new("a"), TestModel::new("b")], &["--allow-model-control", "--watch", "0"]);
    let mut client = inference(&server).await;
    assert_eq!(index(&mut client, false).await, ["a 1 READY", "b 1 READY"]);

    unload(&mut client, "b").await.unwrap();
    assert_eq!(index(&mut client, true).await, ["a 1 READY"]);
    assert_eq!(index(&mut client, false).await, ["a 1 READY", "b  UNAVAILABLE"]);
    let volume = blobs(RESOLUTION, Isometry3::identity(), &[[5, 5, 5]]);
    let detect = DetectOptions { model: "b".to_owned(), ..DetectOptions::default() };
    let options = Options { detect, ..Options::default() };
    let error = server.client().await.detect(&volume, options.clone()).await.unwrap_err();
    assert_eq!(error.code(), Some(Code::NotFound), "{error}");
    // A reload for another reason does not load it.
    load(&mut client, "a").await.unwrap();
    assert_eq!(index(&mut client, true).await, ["a 1 READY"]);

    // A load also reads new files.
    TestModel::new("b").version("2").write(server.models());
    load(&mut client, "b").await.unwrap();
    assert_eq!(index(&mut client, false).await, ["a 1 READY", "b 2 READY", "b 1 READY"]);
    assert_eq!(server.client().await.detect(&volume, options).await.unwrap().version, "2");

    std::fs::write(server.models().join("broken.onnx"), "text").unwrap();
    let error = load(&mut client, "broken").await.unwrap_err();
    assert_eq!(error.code(), Code::FailedPrecondition);
    assert!(
        error.message().contains("`broken` cannot be served") && error.message().contains("broken.onnx"),
        "{error}"
    );
    // The version that was loaded before is still served, and the client learns that the new file is not.
    std::fs::write(server.models().join("b-2.onnx"), "text").unwrap();
    let error = load(&mut client, "b").await.unwrap_err();
    assert!(error.message().contains("`b` cannot be served") && error.message().contains("b-2.onnx"), "{error}");
    assert!(index(&mut client, true).await.contains(&"b 2 READY".to_owned()));
    std::fs::remove_file(server.models().join("b-2.onnx")).unwrap();
    assert_eq!(load(&mut client, "missing").await.unwrap_err().code(), Code::NotFound);
    // A load that fails does not undo an unloading.
    let good = std::fs::read(server.models().join("b-1.onnx")).unwrap();
    unload(&mut client, "b").await.unwrap();
    for file in ["b-1.onnx", "b-2.onnx"] {
        let _ = std::fs::write(server.models().join(file), "text");
    }
    assert_eq!(load(&mut client, "b").await.unwrap_err().code(), Code::NotFound);
    std::fs::remove_file(server.models().join("b-2.onnx")).unwrap();
    std::fs::write(server.models().join("b-1.onnx"), good).unwrap();
    load(&mut client, "a").await.unwrap();
    assert_eq!(index(&mut client, true).await, ["a 1 READY"]);
    load(&mut client, "b").await.unwrap();

    assert_eq!(unload(&mut client, "missing").await.unwrap_err().code(), Code::NotFound);
    unload(&mut client, "a").await.unwrap();
    let error = unload(&mut client, "b").await.unwrap_err();
    assert!(error.message().contains("`b` is the only network"), "{error}");
    let other = oip::RepositoryModelLoadRequest { repository_name: "s3".to_owned(), ..Default::default() };
    assert_eq!(client.repository_model_load(other).await.unwrap_err().code(), Code::InvalidArgument);
}

#[tokio::test]
async fn models_are_not_changed_where_it_is_not_allowed() {
    let server = Server::run(&[TestModel::new("a"), TestModel::new("b")], &[]);
    let mut client = inference(&server).await;
    for refused in [load(&mut client, "a").await, unload(&mut client, "a").await] {
        let refused = refused.unwrap_err();
        assert_eq!(refused.code(), Code::PermissionDenied);
        assert!(refused.message().contains("--allow-model-control"), "{refused}");
    }
    assert_eq!(index(&mut client, false).await, ["a 1 READY", "b 1 READY"]);
}

#[tokio::test]
async fn statistics_count_inferences() {
    let server = Server::run(&[TestModel::new("a"), TestModel::new("b")], &[]);
    let mut inference = inference(&server).await;
    let client = server.client().await;
    let volume = blobs(RESOLUTION, Isometry3::identity(), &[[5, 5, 5]]);
    for _ in 0..3 {
        client.detect(&volume, Options::default()).await.unwrap();
    }
    let request = |name: &str| oip::ModelStatisticsRequest { name: name.to_owned(), version: String::new() };
    let all = inference.model_statistics(request("")).await.unwrap().into_inner().model_stats;
    assert_eq!(all.iter().map(|model| &*model.name).collect::<Vec<_>>(), ["a", "b"]);
    let [a] = &inference.model_statistics(request("a")).await.unwrap().into_inner().model_stats[..] else { panic!() };
    assert_eq!((a.inference_count, a.execution_count), (3, 3));
    let stages = a.inference_stats.unwrap();
    let [success, queue, infer] = [stages.success, stages.queue, stages.compute_infer].map(Option::unwrap);
    assert_eq!([success.count, queue.count, infer.count], [3; 3]);
    assert!(0 < infer.ns && infer.ns < success.ns, "{stages:?}");
    assert!(a.last_inference > 1_700_000_000_000);
    assert_eq!((all[1].inference_count, all[1].last_inference), (0, 0));
    assert_eq!(inference.model_statistics(request("c")).await.unwrap_err().code(), Code::NotFound);
}

#[tokio::test]
async fn parameters_that_are_not_honoured_are_refused() {
    let server = Server::run(&[TestModel::new("a")], &[]);
    let mut client = inference(&server).await;
    let parameters = |name: &str| {
        let parameter = oip::InferParameter { parameter_choice: Some(ParameterChoice::Int64Param(7)) };
        [(name.to_owned(), parameter)].into()
    };
    let edge = RESOLUTION as i64;
    let input = oip::model_infer_request::InferInputTensor {
        name: "tsdf".to_owned(),
        datatype: "FP32".to_owned(),
        shape: vec![1, 1, edge, edge, edge],
        ..Default::default()
    };
    let request = oip::ModelInferRequest {
        model_name: "a".to_owned(),
        inputs: vec![input.clone()],
        raw_input_contents: vec![0.5_f32.to_le_bytes().repeat(RESOLUTION.pow(3)).into()],
        ..Default::default()
    };
    client.model_infer(request.clone()).await.unwrap();
    let output = oip::model_infer_request::InferRequestedOutputTensor {
        name: "width".to_owned(),
        parameters: parameters("classification"),
    };
    for (request, expected) in [
        (oip::ModelInferRequest { parameters: parameters("timeout"), ..request.clone() }, "parameters is `timeout`"),
        (
            oip::ModelInferRequest {
                inputs: vec![oip::model_infer_request::InferInputTensor {
                    parameters: parameters("shared_memory_region"),
                    ..input
                }],
                ..request.clone()
            },
            "inputs[0].parameters is `shared_memory_region`",
        ),
        (oip::ModelInferRequest { outputs: vec![output], ..request }, "outputs[0].parameters is `classification`"),
    ] {
        let error = client.model_infer(request).await.unwrap_err();
        assert_eq!(error.code(), Code::InvalidArgument);
        assert!(error.message().contains(expected), "{error}");
    }
}

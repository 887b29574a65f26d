//! `grasp watch --live`, as Foxglove sees it.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{BufRead, BufReader};
use std::net::TcpListener;
use std::path::Path;
use std::process::{Child, ChildStderr, Command, Stdio};
use std::time::Duration;

use foxglove::Decode;
use foxglove::messages::{LinePrimitive, PointCloud, SceneEntity, SceneUpdate, scene_entity_deletion};
use futures_util::{SinkExt, StreamExt};
use grasp_tests::scene::TABLE;
use grasp_tests::{RESOLUTION, Server, TestModel, blobs, grasp};
use nalgebra::{Isometry3, Point3, Quaternion, Translation3, UnitQuaternion};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::{Value, json};
use tokio::net::TcpStream;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::client::IntoClientRequest;
use tokio_tungstenite::{MaybeTlsStream, WebSocketStream, connect_async};

use crate::cli::{cloud_files, depth_files, pose, text, write};

/// A running `grasp watch --live`.
struct Watch {
    process: Child,
    stderr: BufReader<ChildStderr>,
    /// What a viewer connects to.
    url: String,
}

impl Watch {
    fn start(server: &Server, args: &[&str]) -> Self {
        let mut command = Command::new(grasp());
        command.arg("watch").args(args).args(["--json", "--every", "0.02", "--live", "127.0.0.1:0"]);
        command.env("GRASP_SERVER", server.grpc().to_string()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut process = command.spawn().unwrap();
        let (mut stderr, mut line) = (BufReader::new(process.stderr.take().unwrap()), String::new());
        stderr.read_line(&mut line).unwrap();
        let url = line.split(' ').find(|word| word.starts_with("ws://")).unwrap_or_else(|| panic!("{line}"));
        Self { url: url.to_owned(), process, stderr }
    }

    /// The detections as they are printed.
    fn answers(&mut self) -> impl Iterator<Item = Value> + use<> {
        let stdout = BufReader::new(self.process.stdout.take().unwrap());
        serde_json::Deserializer::from_reader(stdout).into_iter().map(Result::unwrap)
    }

    /// Ends it as Ctrl-C does. Returns what else it reported.
    fn interrupt(mut self) -> String {
        kill_process(Pid::from_child(&self.process), Signal::INT).unwrap();
        let reported = std::io::read_to_string(&mut self.stderr).unwrap();
        assert!(self.process.wait().unwrap().success(), "{reported}");
        reported
    }
}

/// What a viewer shows that subscribes to every topic, by the protocol's specification:
/// <https://github.com/foxglove/foxglove-sdk/blob/main/docs/protocol/websocket.md>.
struct Viewer {
    socket: WebSocketStream<MaybeTlsStream<TcpStream>>,
    /// Topic and schema of each channel.
    channels: BTreeMap<u64, (String, String)>,
    clouds: BTreeMap<String, PointCloud>,
    entities: BTreeMap<String, BTreeMap<String, SceneEntity>>,
    errors: BTreeMap<String, String>,
    /// Size of the largest message, bytes.
    largest: usize,
}

impl Viewer {
    async fn connect(url: &str) -> Self {
        let mut request = url.into_client_request().unwrap();
        request.headers_mut().insert("Sec-WebSocket-Protocol", "foxglove.sdk.v1".parse().unwrap());
        let (socket, _) = connect_async(request).await.unwrap();
        Self {
            socket,
            channels: BTreeMap::new(),
            clouds: BTreeMap::new(),
            entities: BTreeMap::new(),
            errors: BTreeMap::new(),
            largest: 0,
        }
    }

    /// Receives messages until the view is as expected.
    async fn receive_until(&mut self, is_expected: impl Fn(&Self) -> bool) {
        let receive = async {
            while !is_expected(self) {
                let message = self.socket.next().await.expect("the connection stays open").unwrap();
                self.show(message).await;
            }
        };
        let received = tokio::time::timeout(Duration::from_secs(60), receive).await;
        assert!(received.is_ok(), "{:?}, {} grasps, {:?}", self.topics(), self.grasps(), self.errors);
    }

    async fn show(&mut self, message: Message) {
        match message {
            Message::Text(text) => self.control(&serde_json::from_str(&text).unwrap()).await,
            Message::Binary(bytes) => {
                self.largest = self.largest.max(bytes.len());
                let (&opcode, rest) = bytes.split_first().unwrap();
                let (subscription, rest) = rest.split_first_chunk::<4>().unwrap();
                let (_log_time, data) = rest.split_first_chunk::<8>().unwrap();
                assert_eq!(opcode, 1, "a message of a topic");
                let (topic, schema) = &self.channels[&u64::from(u32::from_le_bytes(*subscription))];
                match &**schema {
                    "foxglove.PointCloud" => {
                        self.clouds.insert(topic.clone(), PointCloud::decode(data).unwrap());
                    }
                    "foxglove.SceneUpdate" => {
                        let SceneUpdate { deletions, entities } = SceneUpdate::decode(data).unwrap();
                        let shown = self.entities.entry(topic.clone()).or_default();
                        for deletion in deletions {
                            assert_eq!(deletion.r#type, i32::from(scene_entity_deletion::Type::All));
                            shown.clear();
                        }
                        shown.extend(entities.into_iter().map(|entity| (entity.id.clone(), entity)));
                    }
                    other => panic!("{other}"),
                }
            }
            other => panic!("{other:?}"),
        }
    }

    async fn control(&mut self, message: &Value) {
        match message["op"].as_str().unwrap() {
            "advertise" => {
                let mut subscriptions = Vec::new();
                for channel in message["channels"].as_array().unwrap() {
                    assert_eq!(
                        (&channel["encoding"], &channel["schemaEncoding"]),
                        (&json!("protobuf"), &json!("protobuf"))
                    );
                    let id = channel["id"].as_u64().unwrap();
                    let name = |key: &str| channel[key].as_str().unwrap().to_owned();
                    self.channels.insert(id, (name("topic"), name("schemaName")));
                    subscriptions.push(json!({ "id": id, "channelId": id }));
                }
                let subscribe = json!({ "op": "subscribe", "subscriptions": subscriptions });
                self.socket.send(Message::text(subscribe.to_string())).await.unwrap();
            }
            "status" => {
                let word = |key: &str| message[key].as_str().unwrap().to_owned();
                self.errors.insert(word("id"), word("message"));
            }
            "removeStatus" => {
                for id in message["statusIds"].as_array().unwrap() {
                    self.errors.remove(id.as_str().unwrap());
                }
            }
            "serverInfo" => {}
            other => panic!("{other}"),
        }
    }

    /// The topics that are shown.
    fn topics(&self) -> BTreeSet<&str> {
        self.clouds.keys().chain(self.entities.keys()).map(String::as_str).collect()
    }

    fn grasps(&self) -> usize {
        self.entities.get("/grasps").map_or(0, BTreeMap::len)
    }

    /// The points of a cloud in the frame of the grasps, metres.
    fn points(&self, topic: &str) -> Vec<Point3<f64>> {
        let cloud = &self.clouds[topic];
        let names: Vec<_> = cloud.fields.iter().map(|field| (&*field.name, field.offset)).collect();
        assert_eq!(names[..3], [("x", 0), ("y", 4), ("z", 8)]);
        let coordinate = |bytes: &[u8; 4]| f64::from(f32::from_le_bytes(*bytes));
        let point =
            |bytes: &[u8]| Point3::from_slice(&bytes.as_chunks().0[..3].iter().map(coordinate).collect::<Vec<_>>());
        cloud.data.chunks_exact(cloud.point_stride as usize).map(point).collect()
    }

    /// Pose of the workspace, and the largest coordinates of its lines in it; height of the table.
    fn workspace(&self) -> (Isometry3<f64>, [f64; 3], f64) {
        let lines = &self.entities["/workspace"]["workspace"].lines;
        let largest = |axis: fn(&foxglove::messages::Point3) -> f64| {
            lines.iter().flat_map(|line| &line.points).map(axis).fold(f64::NEG_INFINITY, f64::max)
        };
        let [edges, table, ..] = &lines[..] else { panic!("{lines:?}") };
        assert_eq!((edges.points.len(), table.points.len()), (24, 8));
        (place(edges), [largest(|p| p.x), largest(|p| p.y), largest(|p| p.z)], table.points[0].z)
    }

    /// Where the fingers of each hand end, in the middle between them.
    fn fingertips(&self) -> Vec<Point3<f64>> {
        let middle = |entity: &SceneEntity| {
            let [_, a, _, b, ..] = &entity.lines[0].points[..] else { panic!("{entity:?}") };
            place(&entity.lines[0]) * Point3::new(a.x + b.x, a.y + b.y, a.z + b.z).map(|sum| sum / 2.0)
        };
        self.entities["/grasps"].values().map(middle).collect()
    }
}

fn place(line: &LinePrimitive) -> Isometry3<f64> {
    let pose = line.pose.as_ref().unwrap();
    let (p, q) = (pose.position.as_ref().unwrap(), pose.orientation.as_ref().unwrap());
    let rotation = UnitQuaternion::new_unchecked(Quaternion::new(q.w, q.x, q.y, q.z));
    Isometry3::from_parts(Translation3::new(p.x, p.y, p.z), rotation)
}

/// Replaces the volume in one step, so that no incomplete file is read.
fn replace(path: &Path, blocks: &[[usize; 3]]) {
    let new = path.with_extension("new");
    let volume = blobs(RESOLUTION, Isometry3::identity(), blocks);
    write(&new, npyz::Order::C, volume.values().iter().copied());
    std::fs::rename(new, path).unwrap();
}

#[tokio::test]
async fn each_detection_replaces_the_one_before_and_late_viewers_get_the_newest() {
    let server = Server::run(&[TestModel::new("mirror")], &[]);
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("volume.npy");
    replace(&file, &[[4, 5, 6], [11, 10, 9]]);
    // The hands are drawn at the same place in every convention of the poses.
    let mut watch = Watch::start(&server, &[file.to_str().unwrap(), "--origin", "tcp", "--closing", "x"]);
    let mut answers = watch.answers();
    let mut viewer = Viewer::connect(&watch.url).await;
    let topics = BTreeSet::from(["/surface", "/workspace", "/grasps", "/hands"]);

    let printed = answers.next().unwrap();
    viewer.receive_until(|viewer| viewer.grasps() == 2 && viewer.topics() == topics).await;
    for (grasp, tip) in printed["grasps"].as_array().unwrap().iter().zip(viewer.fingertips()) {
        assert!((pose(grasp).translation.vector - tip.coords).norm() < 1e-6, "{grasp}: {tip}");
    }
    let (frame_from_task, lengths, table) = viewer.workspace();
    assert!(frame_from_task == Isometry3::identity() && table == TABLE, "{frame_from_task}, {table} m");
    assert!(lengths.iter().all(|length| (length - 0.3).abs() < 1e-9), "{lengths:?}");

    replace(&file, &[[11, 10, 9]]);
    viewer.receive_until(|viewer| viewer.grasps() == 1).await;
    std::fs::write(&file, "not an array").unwrap();
    viewer.receive_until(|viewer| !viewer.errors.is_empty()).await;
    assert!(viewer.errors["detection"].contains("volume.npy") && viewer.grasps() == 1, "{:?}", viewer.errors);

    let mut late = Viewer::connect(&watch.url).await;
    late.receive_until(|viewer| viewer.topics() == topics && !viewer.errors.is_empty()).await;
    assert_eq!((late.grasps(), late.fingertips()), (1, viewer.fingertips()));
    assert_eq!(late.points("/hands").len(), 4 * 33);
    assert_eq!(late.errors, viewer.errors);

    replace(&file, &[[4, 5, 6], [11, 10, 9]]);
    for viewer in [&mut viewer, &mut late] {
        viewer.receive_until(|viewer| viewer.grasps() == 2 && viewer.errors.is_empty()).await;
    }

    let reported = watch.interrupt();
    assert!(reported.contains("volume.npy") && reported.lines().count() == 1, "{reported}");
    for viewer in [viewer, late] {
        let rest: Vec<_> = viewer.socket.map(Result::unwrap).collect().await;
        assert!(matches!(rest.last(), Some(Message::Close(_))), "{rest:?}");
    }
}

#[tokio::test]
async fn depth_images_and_clouds_are_shown_with_their_workspace() {
    let server = Server::run(&[TestModel::new("mirror").resolution(40)], &[]);
    let folder = tempfile::tempdir().unwrap();
    let images = depth_files(folder.path()).remove(0);
    let [clouds, _] = cloud_files(folder.path());
    let with = |flags: &[String], more: &[&str]| -> Vec<String> {
        flags.iter().cloned().chain(more.iter().map(|flag| (*flag).to_owned())).collect()
    };
    // One image whose camera has no known pose.
    let one_image = [&images[..1], &images[2..4]].concat();
    let scenes = [
        images.clone(),
        clouds,
        with(&images, &["--workspace=0,0,0", "--extent", "0.35,0.3"]),
        with(&one_image, &["--find-table"]),
    ];
    for flags in scenes {
        let args: Vec<_> =
            flags.iter().map(String::as_str).chain(["--threshold", "0.6", "--collision", "off"]).collect();
        let mut watch = Watch::start(&server, &args);
        let mut viewer = Viewer::connect(&watch.url).await;
        let topics = BTreeSet::from(["/cloud", "/surface", "/workspace", "/grasps", "/hands"]);
        viewer.receive_until(|viewer| viewer.topics() == topics).await;
        let printed = watch.answers().next().unwrap();
        assert_eq!(viewer.grasps(), printed["grasps"].as_array().unwrap().len());
        assert!(viewer.grasps() > 3 && viewer.largest < 1_000_000, "{} bytes", viewer.largest);

        let (frame_from_task, [x, y, z], table) = viewer.workspace();
        assert!((table - TABLE).abs() < 1e-9 && (z - 0.3).abs() < 1e-9, "{table} m, {z} m");
        if let Some(found) = printed["table"]["workspace"]["position"].as_array() {
            let position: Vec<f64> = found.iter().filter_map(Value::as_f64).collect();
            assert!((frame_from_task.translation.vector - Point3::from_slice(&position).coords).norm() < 1e-7);
        }
        let extent = if args.contains(&"--extent") { [0.35, 0.3] } else { [x.min(0.3), y.min(0.3)] };
        assert!(args.contains(&"--find-table") || (x - extent[0]).abs() + (y - extent[1]).abs() < 1e-9, "{x}, {y}");
        // Above the table is only the block, of 0.1 m.
        for topic in ["/cloud", "/surface"] {
            let heights =
                viewer.points(topic).into_iter().map(|point| frame_from_task.inverse_transform_point(&point).z);
            let heights: Vec<f64> = heights.collect();
            let highest = heights.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            let on_table = heights.iter().filter(|height| (*height - TABLE).abs() < 0.005).count();
            assert!((highest - TABLE - 0.1).abs() < 0.01, "{args:?}: {topic} to {highest} m");
            assert!(2 * on_table > heights.len(), "{args:?}: {topic}: {on_table} of {}", heights.len());
        }
        let outside = |point: &Point3<f64>| {
            let p = frame_from_task.inverse_transform_point(point);
            p.x < 0.0 || p.y < 0.0 || p.x > x || p.y > y
        };
        assert!(viewer.points("/cloud").iter().any(outside) && !viewer.points("/surface").iter().all(outside));
        watch.interrupt();
    }
}

#[test]
fn an_address_in_use_is_reported_with_what_to_do() {
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap().to_string();
    let watch = |live: &str| Command::new(grasp()).args(["watch", "volume.npy", "--live", live]).output().unwrap();
    let output = watch(&address);
    let error = text(&output.stderr);
    assert!(!output.status.success() && error.lines().count() == 1, "{error}");
    assert!(error.contains(&format!("--live {address}: another program uses this port; end it, or")), "{error}");
    let output = watch("depth.png");
    let error = text(&output.stderr);
    assert!(error.contains("must be HOST:PORT; give the files before --live"), "{error}");
}

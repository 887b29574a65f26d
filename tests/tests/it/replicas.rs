//! Two servers behind a load balancer, one of which is killed or drains.

use std::net::{SocketAddr, TcpListener};
use std::process::{Child, Command};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use grasp_client::{Access, Arrivals, Client, DataType, Options, Retry, Until, load};
use grasp_tests::{Server, TestModel, blobs};
use nalgebra::Isometry3;
use tokio::task::JoinSet;
use tonic::Code;

const RESOLUTION: usize = 40;

/// haproxy with the configuration in deploy/.
struct Balancer {
    process: Child,
    address: SocketAddr,
}

impl Balancer {
    fn run(replicas: [&Server; 2]) -> Self {
        let haproxy =
            std::env::var_os("GRASPD_HAPROXY").expect("GRASPD_HAPROXY is not set: run the tests by `make test`");
        let address = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
        let mut command = Command::new(haproxy);
        command.args(["-f", concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/haproxy.cfg")]);
        command.env("GRASPD_BALANCER", address.to_string());
        for (number, replica) in (1..).zip(replicas) {
            command.env(format!("GRASPD_REPLICA_{number}"), replica.grpc().to_string());
            command.env(format!("GRASPD_REPLICA_{number}_HTTP"), replica.http().port().to_string());
        }
        Self { process: command.spawn().unwrap(), address }
    }
}

impl Drop for Balancer {
    fn drop(&mut self) {
        self.process.kill().unwrap();
        self.process.wait().unwrap();
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn requests_with_retries_succeed_when_a_replica_is_killed() {
    const CALLS: usize = 2000;
    let model = || TestModel::new("mirror").resolution(RESOLUTION);
    let (survivor, victim) = (Server::run(&[model()], &["--log", "warn"]), Server::run(&[model()], &["--log", "warn"]));
    let balancer = Balancer::run([&survivor, &victim]);
    Client::wait_ready(balancer.address.to_string(), Duration::from_mins(1)).await.unwrap();
    let access = Access { retry: Retry::RECOMMENDED, ..Access::default() };
    let client = Client::connect_with(balancer.address.to_string(), access).await.unwrap();
    let volume = Arc::new(blobs(RESOLUTION, Isometry3::identity(), &[[10, 20, 15]]));

    let by_victim = || victim.metric("graspd_requests_total{code=\"OK\",model=\"mirror 1\"}");
    let made = Arc::new(AtomicUsize::new(0));
    let calls = {
        let made = Arc::clone(&made);
        load(Arrivals::Callers(8), Until::Calls(CALLS), move |_| {
            let (client, volume) = (client.clone(), Arc::clone(&volume));
            made.fetch_add(1, Ordering::Relaxed);
            async move {
                let options = Options { dtype: DataType::F32, ..Options::default() };
                let detection = client.detect(&volume, options).await.map_err(|error| {
                    eprintln!("{error}");
                    error.code().unwrap_or(Code::Unknown)
                })?;
                assert_eq!(detection.grasps.len(), 1);
                Ok(())
            }
        })
    };
    let calls = tokio::spawn(calls);
    while made.load(Ordering::Relaxed) < CALLS / 4 {
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
    assert!(by_victim() > 0.0, "the victim has answered requests");
    // Dropping the server sends SIGKILL.
    drop(victim);
    let report = calls.await.unwrap();
    assert_eq!((report.answered.len(), report.refusals()), (CALLS, 0), "{:?}", report.refused.keys());
    println!("{CALLS} calls, slowest {:?}", report.answered.last().unwrap());
}

#[tokio::test(flavor = "multi_thread")]
async fn accepted_calls_succeed_while_a_replica_drains() {
    // The eight inferences of a replica take longer than the balancer needs to mark it as down.
    const CALLS: u32 = 16;
    let replica = || {
        let slow = TestModel::new("slow").convolutions(60);
        Server::run(&[slow], &["--log", "warn", "--drain-timeout", "60"])
    };
    let (survivor, mut victim) = (replica(), replica());
    let balancer = Balancer::run([&survivor, &victim]);
    // This client does not retry: a call that the balancer ends fails.
    let client = Client::wait_ready(balancer.address.to_string(), Duration::from_mins(1)).await.unwrap();
    let volume = Arc::new(blobs(grasp_tests::RESOLUTION, Isometry3::identity(), &[[5, 5, 5]]));
    let mut calls = JoinSet::new();
    for _ in 0..CALLS {
        let (client, volume) = (client.clone(), Arc::clone(&volume));
        calls.spawn(async move { client.detect(&volume, Options::default()).await });
    }
    let accepted = "graspd_queued_total{model=\"slow 1\",priority=\"NORMAL\"}";
    victim.wait_until(accepted, |by_victim| by_victim + survivor.metric(accepted) == f64::from(CALLS)).await;
    assert!(victim.metric("graspd_queue_requests{model=\"slow 1\"}") > 0.0, "the victim has accepted calls");
    victim.terminate().unwrap();
    for outcome in calls.join_all().await {
        assert_eq!(outcome.unwrap().grasps.len(), 1);
    }
    assert_eq!(victim.wait().unwrap().code(), Some(0));
}

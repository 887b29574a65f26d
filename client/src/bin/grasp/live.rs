//! Live view: a server to which Foxglove connects, with the protocol `foxglove.sdk.v1` over WebSocket.

use std::collections::BTreeMap;
use std::fmt;
use std::io::ErrorKind;
use std::str::FromStr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use anyhow::anyhow;
use foxglove::websocket::{ChannelView, Client, ServerListener, Status};
use foxglove::{Context, FoxgloveError, PartialMetadata, RawChannel, SinkId, WebSocketServer, WebSocketServerHandle};

use crate::messages::Message;

/// Where the server listens by default: the address that Foxglove proposes for a connection.
pub(crate) const DEFAULT_ADDRESS: &str = "127.0.0.1:8765";

/// Largest number of messages queued for a viewer. Beyond it the oldest are dropped; newer ones of the same topics
/// follow.
const BACKLOG: usize = 32;

/// Id of the status message with the error of the newest detection.
const STATUS: &str = "detection";

/// Time limit for closing the connections.
const CLOSE_LIMIT: Duration = Duration::from_secs(1);

/// Host and port to listen on.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Address {
    host: String,
    port: u16,
}

/// A running server. It uses the runtime in which it was started.
pub(crate) struct Live {
    server: WebSocketServerHandle,
    topics: Arc<Topics>,
}

/// What a viewer gets when it subscribes to a topic.
struct Topics {
    context: Arc<Context>,
    newest: Mutex<Newest>,
}

#[derive(Default)]
struct Newest {
    /// The newest message of each topic, with its channel.
    messages: BTreeMap<&'static str, (Arc<RawChannel>, Message)>,
    /// Why a later detection failed.
    error: Option<String>,
}

impl Live {
    pub async fn start(address: &Address) -> anyhow::Result<Self> {
        let topics = Arc::new(Topics { context: Context::new(), newest: Mutex::default() });
        let server = WebSocketServer::new()
            .name("grasp watch")
            .context(&topics.context)
            .listener(Arc::clone(&topics) as Arc<dyn ServerListener>)
            .message_backlog_size(BACKLOG)
            .bind(&address.host, address.port)
            .start()
            .await
            .map_err(|error| match error {
                FoxgloveError::Bind(error) if error.kind() == ErrorKind::AddrInUse => anyhow!(
                    "--live {address}: another program uses this port; end it, or give another port, such as \
                     --live {}:{}",
                    address.host,
                    address.port.checked_add(1).unwrap_or(8765)
                ),
                FoxgloveError::Bind(error) => anyhow!("--live {address}: cannot listen there: {error}"),
                error => anyhow!("--live {address}: {error}"),
            })?;
        Ok(Self { server, topics })
    }

    /// What a viewer connects to.
    pub fn url(&self, address: &Address) -> String {
        format!("ws://{}", Address { port: self.server.port(), ..address.clone() })
    }

    /// Shows a detection instead of the one before.
    pub fn publish(&self, messages: Vec<Message>) -> anyhow::Result<()> {
        let mut newest = self.topics.newest();
        if newest.error.take().is_some() {
            self.server.remove_status(vec![STATUS.to_owned()]);
        }
        for message in messages {
            let channel = match newest.messages.remove(message.topic) {
                Some((channel, _)) => channel,
                None => self
                    .topics
                    .context
                    .channel_builder(message.topic)
                    .schema(message.schema.clone())
                    .message_encoding(&message.encoding)
                    .build_raw()?,
            };
            send(&channel, &message, None);
            newest.messages.insert(message.topic, (channel, message));
        }
        Ok(())
    }

    /// Shows why a detection failed. The detection before stays in view.
    pub fn publish_error(&self, error: &str) {
        self.server.publish_status(status(error));
        self.topics.newest().error = Some(error.to_owned());
    }

    /// Closes the connections.
    pub async fn stop(self) {
        // A viewer that reads nothing does not keep the program running.
        let _ = tokio::time::timeout(CLOSE_LIMIT, self.server.stop().wait()).await;
    }
}

impl Topics {
    fn newest(&self) -> MutexGuard<'_, Newest> {
        self.newest.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl ServerListener for Topics {
    fn on_subscribe(&self, client: Client, channel: ChannelView) {
        // The lock is held during sending, so that no older message follows a newer one.
        let newest = self.newest();
        if let Some((channel, message)) = newest.messages.get(channel.topic()) {
            send(channel, message, client.sink_id());
        }
        if let Some(error) = &newest.error {
            client.send_status(status(error));
        }
    }
}

fn status(error: &str) -> Status {
    Status::error(error).with_id(STATUS)
}

/// Sends a message to one viewer, or to all that have subscribed.
fn send(channel: &RawChannel, message: &Message, to: Option<SinkId>) {
    channel.log_with_meta_to_sink(&message.data, PartialMetadata::with_log_time(message.time), to);
}

impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}", self.host, self.port)
    }
}

impl FromStr for Address {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let address = text.rsplit_once(':').and_then(|(host, port)| Some((host, port.parse().ok()?)));
        // A path of a file behind `--live` is the most likely mistake.
        let (host, port) = address
            .filter(|(host, _)| !host.is_empty() && !host.contains('/'))
            .ok_or("must be HOST:PORT; give the files before --live")?;
        Ok(Self { host: host.to_owned(), port })
    }
}

//! Connections, TLS, tokens, deadlines, and limits on messages and buffered responses.

pub(crate) mod address;
pub(crate) mod caller;
pub(crate) mod connections;
pub(crate) mod deadline;
pub(crate) mod http_connections;
pub(crate) mod listener;
pub(crate) mod receive_budget;
pub(crate) mod request_body;
pub(crate) mod response_buffer;
pub(crate) mod tls;
pub(crate) mod tokens;

//! The address of the gRPC listener: TCP, or a UNIX socket.

use std::fmt::{self, Display};
use std::io;
use std::net::SocketAddr;
use std::os::unix::fs::FileTypeExt;
use std::path::PathBuf;
use std::pin::Pin;
use std::str::FromStr;

use tokio::net::{TcpListener, TcpStream, UnixListener, UnixStream};
use tokio_stream::wrappers::UnixListenerStream;
use tokio_stream::{Stream, StreamExt};
use tokio_util::either::Either;
use tonic::transport::server::TcpIncoming;

/// Prefix of the address of a UNIX socket.
const UNIX: &str = "unix:";

/// Where to listen.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Address {
    Tcp(SocketAddr),
    Unix(PathBuf),
}

/// A connected socket.
pub(crate) type Socket = Either<TcpStream, UnixStream>;

/// A bound listener. The file of a UNIX socket is removed when it is dropped.
pub(crate) struct Listener {
    pub address: Address,
    sockets: Pin<Box<dyn Stream<Item = io::Result<Socket>> + Send>>,
    _file: Option<SocketFile>,
}

struct SocketFile(PathBuf);

impl Address {
    /// Binds the address. The file of a UNIX socket on which no process listens any more is replaced.
    pub async fn bind(&self) -> io::Result<Listener> {
        match self {
            Self::Tcp(address) => {
                let listener = TcpListener::bind(address).await?;
                let address = Self::Tcp(listener.local_addr()?);
                // `Server::tcp_nodelay` has no effect on a listener that is already bound. Without TCP_NODELAY, a
                // response of several packets is delayed by 40 ms until the client acknowledges the first.
                let sockets = TcpIncoming::from(listener).with_nodelay(Some(true));
                let sockets = Box::pin(sockets.map(|socket| socket.map(Either::Left)));
                Ok(Listener { address, sockets, _file: None })
            }
            Self::Unix(path) => {
                let is_socket = std::fs::symlink_metadata(path).is_ok_and(|file| file.file_type().is_socket());
                let is_refused = |error: io::Error| error.kind() == io::ErrorKind::ConnectionRefused;
                if is_socket && UnixStream::connect(path).await.is_err_and(is_refused) {
                    std::fs::remove_file(path)?;
                }
                let sockets = UnixListenerStream::new(UnixListener::bind(path)?);
                let sockets = Box::pin(sockets.map(|socket| socket.map(Either::Right)));
                Ok(Listener { address: self.clone(), sockets, _file: Some(SocketFile(path.clone())) })
            }
        }
    }
}

impl Listener {
    /// The connections.
    pub fn sockets(self) -> impl Stream<Item = io::Result<Socket>> {
        let Self { sockets, _file: file, .. } = self;
        sockets.map(move |socket| {
            let _removed_with_the_stream = &file;
            socket
        })
    }
}

/// The address of the client; UNIX sockets have none.
pub(crate) fn peer(socket: &Socket) -> Option<SocketAddr> {
    match socket {
        Either::Left(socket) => socket.peer_addr().ok(),
        Either::Right(_) => None,
    }
}

impl Drop for SocketFile {
    fn drop(&mut self) {
        // Fails if it was removed already.
        let _ = std::fs::remove_file(&self.0);
    }
}

impl FromStr for Address {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match text.strip_prefix(UNIX) {
            Some("") => Err("the path of the UNIX socket is missing"),
            Some(path) => Ok(Self::Unix(path.into())),
            None => text.parse().map(Self::Tcp).map_err(|_| "must be an IP address with a port, or unix:PATH"),
        }
    }
}

impl Display for Address {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Tcp(address) => write!(formatter, "{address}"),
            Self::Unix(path) => write!(formatter, "{UNIX}{}", path.display()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_is_an_ip_address_with_a_port_or_a_path() {
        for text in ["127.0.0.1:50051", "[::1]:0", "unix:/run/graspd.sock", "unix:relative.sock"] {
            assert_eq!(text.parse::<Address>().unwrap().to_string(), text);
        }
        for text in ["unix:", "localhost:50051", "127.0.0.1", "/run/graspd.sock"] {
            assert!(text.parse::<Address>().is_err(), "{text}");
        }
    }

    #[tokio::test]
    async fn a_left_over_socket_is_replaced_and_a_used_one_and_other_files_are_not() {
        let path = std::env::temp_dir().join(format!("graspd-address-{}.sock", std::process::id()));
        let address = Address::Unix(path.clone());
        // As after a crash: the file stays.
        drop(std::os::unix::net::UnixListener::bind(&path).unwrap());
        assert!(path.exists());
        let listener = address.bind().await.unwrap();
        assert_eq!(address.bind().await.err().unwrap().kind(), io::ErrorKind::AddrInUse);
        drop(listener);
        assert!(!path.exists(), "the file is removed");
        std::fs::write(&path, "text").unwrap();
        assert_eq!(address.bind().await.err().unwrap().kind(), io::ErrorKind::AddrInUse);
        std::fs::remove_file(&path).unwrap();
    }
}

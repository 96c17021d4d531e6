//! Connection settings of both sides: nothing that matters is left to a default.

use std::net::{Ipv4Addr, SocketAddr};

use tonic::transport::server::TcpIncoming;
use tonic::transport::{Channel, Endpoint, Server};

use crate::limits;
use crate::wire::learner_client::LearnerClient;
use crate::wire::learner_server::{Learner, LearnerServer};

/// The address of a metrics port: `IP:PORT`, or `PORT` for one that only this machine reaches.
///
/// # Errors
/// A text that is neither.
///
/// ```
/// use popgym_proto::transport::metrics_address;
///
/// assert_eq!(metrics_address("9100"), Ok("127.0.0.1:9100".parse().unwrap()));
/// assert_eq!(metrics_address("[::]:9100"), Ok("[::]:9100".parse().unwrap()));
/// assert!(metrics_address("localhost").is_err());
/// ```
pub fn metrics_address(text: &str) -> Result<SocketAddr, String> {
    let port = text.parse().map(|port: u16| (Ipv4Addr::LOCALHOST, port).into());
    port.or_else(|_| text.parse())
        .map_err(|_| format!("metrics_listen is `{text}`, allowed is IP:PORT, or PORT for this machine alone"))
}

/// The actor's end of a connection to the learner at `url` (`http://host:port`). Connects to nothing yet.
///
/// # Errors
/// A text that is not a URL.
pub fn endpoint(url: &str) -> Result<Endpoint, tonic::transport::Error> {
    Ok(Endpoint::from_shared(url.to_owned())?
        .connect_timeout(limits::CONNECT_DEADLINE)
        .tcp_nodelay(true)
        .tcp_keepalive(Some(limits::KEEPALIVE_INTERVAL))
        .http2_keep_alive_interval(limits::KEEPALIVE_INTERVAL)
        .keep_alive_timeout(limits::KEEPALIVE_TIMEOUT)
        .keep_alive_while_idle(true)
        .initial_stream_window_size(limits::WINDOW_BYTES)
        .initial_connection_window_size(limits::WINDOW_BYTES)
        .max_frame_size(limits::FRAME_BYTES)
        .http2_max_header_list_size(limits::MAX_HEADER_LIST_BYTES))
}

/// A client over `channel`.
pub fn client(channel: Channel) -> LearnerClient<Channel> {
    LearnerClient::new(channel)
        .max_decoding_message_size(limits::MAX_MESSAGE_BYTES)
        .max_encoding_message_size(limits::MAX_MESSAGE_BYTES)
}

/// The learner's end: the settings of every connection.
pub fn server() -> Server {
    Server::builder()
        .http2_keepalive_interval(Some(limits::KEEPALIVE_INTERVAL))
        .http2_keepalive_timeout(Some(limits::KEEPALIVE_TIMEOUT))
        .initial_stream_window_size(limits::WINDOW_BYTES)
        .initial_connection_window_size(limits::WINDOW_BYTES)
        .max_concurrent_streams(limits::MAX_STREAMS_PER_CONNECTION)
        .http2_max_pending_accept_reset_streams(Some(limits::MAX_PENDING_RESET_STREAMS))
        .http2_max_local_error_reset_streams(Some(limits::MAX_PENDING_RESET_STREAMS))
        .http2_max_header_list_size(limits::MAX_HEADER_LIST_BYTES)
}

/// The learner's listening socket, with the settings that a TCP connection has.
pub fn incoming(listener: tokio::net::TcpListener) -> TcpIncoming {
    TcpIncoming::from(listener).with_nodelay(Some(true)).with_keepalive(Some(limits::KEEPALIVE_INTERVAL))
}

/// The learner's service around its implementation.
pub fn service<L: Learner>(learner: L) -> LearnerServer<L> {
    LearnerServer::new(learner)
        .max_decoding_message_size(limits::MAX_MESSAGE_BYTES)
        .max_encoding_message_size(limits::MAX_MESSAGE_BYTES)
}

//! Who is connected: every TCP connection from its acceptance to its end, with limits on how many there are and on how long a
//! stranger may stay.

use std::collections::HashMap;
use std::io;
use std::net::{IpAddr, Ipv4Addr};
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll};
use std::time::Duration;

use popgym_proto::limits;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::TcpStream;
use tokio::sync::mpsc;
use tokio::time::{Instant, Sleep, sleep_until, timeout};
use tokio_rustls::TlsAcceptor;
use tokio_rustls::rustls::ServerConfig;
use tokio_stream::StreamExt as _;
use tonic::transport::server::{Connected, TcpIncoming};
use tracing::warn;

use super::metrics;
use super::reloaded::Reloaded;

/// A peer that is refused again and again is told of once in as long.
const COMPLAINT_INTERVAL: Duration = Duration::from_mins(1);

/// Addresses that were told of are remembered up to this number.
const MAX_COMPLAINTS: usize = 4096;

/// Counts connections.
#[derive(Debug, Default)]
pub(super) struct Gate(Mutex<Counts>);

#[derive(Debug, Default)]
struct Counts {
    connections: usize,
    /// Connections of an address that have not said a legal hello.
    strangers: HashMap<IpAddr, usize>,
    complaints: HashMap<IpAddr, Instant>,
}

/// The other end of a connection.
#[derive(Debug)]
pub(super) struct Peer {
    address: IpAddr,
    gate: Arc<Gate>,
    /// When it is dropped. `None`: it has said hello, and its session has deadlines of its own.
    deadline: Mutex<Option<Instant>>,
}

impl Gate {
    fn counts(&self) -> MutexGuard<'_, Counts> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn admit(self: &Arc<Self>, address: IpAddr) -> Option<Arc<Peer>> {
        let mut counts = self.counts();
        let strangers = counts.strangers.get(&address).copied().unwrap_or_default();
        if counts.connections >= limits::MAX_CONNECTIONS || strangers >= limits::MAX_STRANGERS {
            return None;
        }
        counts.connections += 1;
        metrics::connections(counts.connections);
        counts.strangers.insert(address, strangers + 1);
        let deadline = Mutex::new(Some(Instant::now() + limits::HELLO_DEADLINE));
        Some(Arc::new(Peer { address, gate: self.clone(), deadline }))
    }

    /// Counts a refusal, and tells of it unless this address was told of a moment ago.
    fn refuse(&self, address: IpAddr, reason: &'static str, why: &str) {
        metrics::connection_refused(reason);
        let now = Instant::now();
        let complaints = &mut self.counts().complaints;
        if complaints.len() >= MAX_COMPLAINTS {
            complaints.retain(|_, told| now - *told < COMPLAINT_INTERVAL);
        }
        let recent = complaints.get(&address).is_some_and(|told| now - *told < COMPLAINT_INTERVAL);
        if !recent && complaints.len() < MAX_COMPLAINTS {
            complaints.insert(address, now);
            warn!("refused {address}: {why} (further refusals of this address are not told for a minute)");
        }
    }
}

impl Counts {
    fn stranger_gone(&mut self, address: IpAddr) {
        if let Some(strangers) = self.strangers.get_mut(&address) {
            *strangers -= 1;
            if *strangers == 0 {
                self.strangers.remove(&address);
            }
        }
    }
}

impl Peer {
    fn deadline(&self) -> MutexGuard<'_, Option<Instant>> {
        self.deadline.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// It has said a legal hello.
    pub(super) fn welcome(&self) {
        if self.deadline().take().is_some() {
            self.gate.counts().stranger_gone(self.address);
        }
    }

    /// Its session has ended: it may say hello anew, or go.
    pub(super) fn dismiss(&self) {
        let before = self.deadline().replace(Instant::now() + limits::HELLO_DEADLINE);
        if before.is_none() {
            *self.gate.counts().strangers.entry(self.address).or_default() += 1;
        }
    }

    /// Counts and tells that something of this peer was refused.
    pub(super) fn refuse(&self, reason: &'static str, why: &str) {
        self.gate.refuse(self.address, reason, why);
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        let stranger = self.deadline().is_some();
        let mut counts = self.gate.counts();
        counts.connections -= 1;
        metrics::connections(counts.connections);
        if stranger {
            counts.stranger_gone(self.address);
        }
    }
}

/// One connection, with or without TLS.
pub(super) struct Connection {
    stream: Box<dyn Duplex>,
    peer: Arc<Peer>,
    alarm: Pin<Box<Sleep>>,
}

trait Duplex: AsyncRead + AsyncWrite + Send + Unpin {}
impl<T: AsyncRead + AsyncWrite + Send + Unpin> Duplex for T {}

impl Connected for Connection {
    type ConnectInfo = Arc<Peer>;

    fn connect_info(&self) -> Arc<Peer> {
        self.peer.clone()
    }
}

impl AsyncRead for Connection {
    /// HTTP/2 always waits to read, so this is where a stranger's time ends.
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let deadline = *self.peer.deadline();
        if let Some(deadline) = deadline {
            if self.alarm.deadline() != deadline {
                self.alarm.as_mut().reset(deadline);
            }
            if self.alarm.as_mut().poll(cx).is_ready() {
                self.peer.refuse("deadline", "no hello");
                return Poll::Ready(Err(io::ErrorKind::TimedOut.into()));
            }
        }
        Pin::new(&mut self.stream).poll_read(cx, buffer)
    }
}

impl AsyncWrite for Connection {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write(cx, bytes)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        parts: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write_vectored(cx, parts)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }
}

/// Accepts connections until nobody takes them any more.
pub(super) async fn accept(
    mut incoming: TcpIncoming,
    tls: Option<Reloaded<ServerConfig>>,
    gate: Arc<Gate>,
    accepted: mpsc::Sender<io::Result<Connection>>,
) {
    while let Some(stream) = tokio::select! {
        stream = incoming.next() => stream,
        () = accepted.closed() => None,
    } {
        let stream = match stream {
            Ok(stream) => stream,
            Err(error) => {
                // Out of descriptors, most likely; some will be free again.
                warn!("cannot accept a connection: {error}");
                tokio::time::sleep(Duration::from_millis(100)).await;
                continue;
            }
        };
        let address = stream.peer_addr().map_or(IpAddr::V4(Ipv4Addr::UNSPECIFIED), |peer| peer.ip().to_canonical());
        let Some(peer) = gate.admit(address) else {
            gate.refuse(address, "full", "too many connections");
            continue;
        };
        let acceptor = tls.as_ref().map(|tls| TlsAcceptor::from(tls.get()));
        let accepted = accepted.clone();
        tokio::spawn(async move {
            if let Some(stream) = greet(stream, acceptor, &peer).await {
                let alarm = Box::pin(sleep_until(Instant::now() + limits::HELLO_DEADLINE));
                // Nobody takes it if the service is ending.
                let _ = accepted.send(Ok(Connection { stream, peer, alarm })).await;
            }
        });
    }
}

async fn greet(stream: TcpStream, acceptor: Option<TlsAcceptor>, peer: &Peer) -> Option<Box<dyn Duplex>> {
    let Some(acceptor) = acceptor else { return Some(Box::new(stream)) };
    match timeout(limits::TLS_DEADLINE, acceptor.accept(stream)).await {
        Ok(Ok(stream)) => return Some(Box::new(stream)),
        Ok(Err(error)) => peer.refuse("tls", &format!("TLS: {error}")),
        Err(_) => peer.refuse("tls", "TLS: no handshake"),
    }
    None
}

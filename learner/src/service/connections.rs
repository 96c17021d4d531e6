//! Who is connected: every TCP connection from its acceptance to its end, with limits on how many there are, on how long a
//! stranger may stay, and on what passes that nobody asked for.

use std::collections::HashMap;
use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr};
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, ready};
use std::time::Duration;

use popgym_proto::limits;
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::TcpStream;
use tokio::sync::mpsc;
use tokio::time::{Instant, Sleep, sleep_until, timeout};
use tokio_rustls::TlsAcceptor;
use tokio_rustls::rustls::ServerConfig;
use tokio_stream::StreamExt as _;
use tonic::Status;
use tonic::transport::server::{Connected, TcpIncoming};
use tracing::warn;

use super::allowance::Bucket;
use super::metrics;
use super::reloaded::Reloaded;

/// A peer that is refused again and again is told of once in as long.
const COMPLAINT_INTERVAL: Duration = Duration::from_mins(1);

/// Addresses are remembered up to this number: those that were told of, and those that come again and again.
const MAX_ADDRESSES: usize = 4096;

/// How HTTP/2 begins.
const PREFACE: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";

/// Descriptors that are not of connections: files, pipes of local actors, libraries.
const OTHER_DESCRIPTORS: usize = 256;

/// Counts connections.
#[derive(Debug)]
pub(super) struct Gate {
    counts: Mutex<Counts>,
    /// Most connections.
    room: usize,
}

#[derive(Debug, Default)]
struct Counts {
    connections: usize,
    /// Connections of an address whose actor is not ready.
    strangers: HashMap<IpAddr, usize>,
    /// Of addresses that connect, or ask for something, more often than they should.
    attempts: HashMap<IpAddr, Bucket>,
    complaints: HashMap<IpAddr, Instant>,
}

/// The other end of a connection.
#[derive(Debug)]
pub(super) struct Peer {
    address: IpAddr,
    gate: Arc<Gate>,
    /// When it is dropped. `None`: its actor is ready, and its session has deadlines of its own.
    deadline: Mutex<Option<Instant>>,
    /// Whether it has a session; none has two at once.
    occupied: AtomicBool,
    /// Bytes that it may still send, and at most.
    allowance: AtomicUsize,
    most: AtomicUsize,
    /// It is to be dropped, whatever it does.
    expelled: AtomicBool,
    /// Its first request was paid for with the connection.
    paid: AtomicBool,
    /// Bytes that came from it and went to it so far.
    read: AtomicU64,
    written: AtomicU64,
}

impl Gate {
    /// For as many connections as the limits say and the system allows.
    pub(super) fn new() -> Self {
        let room = descriptors(limits::MAX_CONNECTIONS + OTHER_DESCRIPTORS).saturating_sub(OTHER_DESCRIPTORS);
        if room < limits::MAX_CONNECTIONS {
            warn!("this process may have {room} connections, of {} (ulimit -Hn)", limits::MAX_CONNECTIONS);
        }
        Self { counts: Mutex::default(), room }
    }

    fn counts(&self) -> MutexGuard<'_, Counts> {
        self.counts.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn admit(self: &Arc<Self>, address: IpAddr) -> Option<Arc<Peer>> {
        let mut counts = self.counts();
        let strangers = counts.strangers.get(&address).copied().unwrap_or_default();
        // Whoever has to wait for room does not pay for it: many actors that come at once all get in, one after the other.
        let refused = if counts.connections >= self.room || strangers >= limits::MAX_STRANGERS {
            Some(("full", "too many connections"))
        } else if !counts.attempt(address) {
            Some(("rate", TOO_OFTEN))
        } else {
            None
        };
        if let Some((reason, why)) = refused {
            drop(counts);
            metrics::connection_refused(reason);
            self.complain(address, why);
            return None;
        }
        counts.connections += 1;
        metrics::connections(counts.connections);
        counts.strangers.insert(address, strangers + 1);
        Some(Arc::new(Peer {
            address,
            gate: self.clone(),
            deadline: Mutex::new(Some(Instant::now() + limits::HELLO_DEADLINE)),
            occupied: AtomicBool::new(false),
            allowance: AtomicUsize::new(limits::STRANGER_BYTES),
            most: AtomicUsize::new(limits::STRANGER_BYTES),
            expelled: AtomicBool::new(false),
            paid: AtomicBool::new(true),
            read: AtomicU64::new(0),
            written: AtomicU64::new(0),
        }))
    }

    /// Tells of a refusal, unless this address was told of a moment ago.
    fn complain(&self, address: IpAddr, why: &str) {
        let now = Instant::now();
        let mut counts = self.counts();
        let complaints = &mut counts.complaints;
        if complaints.len() >= MAX_ADDRESSES {
            complaints.retain(|_, told| now - *told < COMPLAINT_INTERVAL);
        }
        let recent = complaints.get(&address).is_some_and(|told| now - *told < COMPLAINT_INTERVAL);
        let told = !recent && complaints.len() < MAX_ADDRESSES;
        if told {
            complaints.insert(address, now);
        }
        drop(counts);
        if told {
            warn!("refused {address}: {why} (further refusals of this address are not told for a minute)");
        }
    }
}

const TOO_OFTEN: &str = "too many connections and requests in a short time";

impl Counts {
    /// Its bucket of attempts. `None`: too many addresses, with whom only the limits on connections are left.
    fn attempts(&mut self, address: IpAddr, now: Instant) -> Option<&mut Bucket> {
        if self.attempts.len() >= MAX_ADDRESSES && !self.attempts.contains_key(&address) {
            self.attempts.retain(|_, bucket| !bucket.is_full(now));
            if self.attempts.len() >= MAX_ADDRESSES {
                return None;
            }
        }
        Some(self.attempts.entry(address).or_insert_with(|| Bucket::new(limits::ATTEMPTS, now)))
    }

    /// Whether an address may do one thing more.
    fn attempt(&mut self, address: IpAddr) -> bool {
        let now = Instant::now();
        self.attempts(address, now).is_none_or(|bucket| bucket.take(now))
    }

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

    /// It asks for something.
    #[allow(clippy::result_large_err)] // tonic's own.
    pub(super) fn attempt(&self) -> Result<(), Status> {
        if self.paid.swap(false, Ordering::Relaxed) || self.gate.counts().attempt(self.address) {
            return Ok(());
        }
        // One that is refused in so many words costs as much as one that is served.
        self.expelled.store(true, Ordering::Relaxed);
        self.refuse("rate", TOO_OFTEN);
        Err(Status::resource_exhausted(TOO_OFTEN))
    }

    /// It begins a session; false if it has one.
    pub(super) fn occupy(&self) -> bool {
        !self.occupied.swap(true, Ordering::Relaxed)
    }

    /// It has said a legal hello.
    pub(super) fn greet(&self) {
        // Its session ends before that, with a word.
        *self.deadline() = Some(Instant::now() + limits::READY_DEADLINE + limits::HELLO_DEADLINE);
    }

    /// Its actor is ready, and sends messages of up to `largest` bytes.
    pub(super) fn welcome(&self, largest: usize) {
        if self.deadline().take().is_some() {
            self.gate.counts().stranger_gone(self.address);
        }
        // One message is being put together while the next ones are under way.
        let most = largest + limits::WINDOW_BYTES as usize + limits::STRANGER_BYTES;
        self.most.store(most, Ordering::Relaxed);
        self.allowance.store(most, Ordering::Relaxed);
    }

    /// Its session has ended: it may say hello anew, or go.
    pub(super) fn dismiss(&self) {
        let before = self.deadline().replace(Instant::now() + limits::HELLO_DEADLINE);
        if before.is_none() {
            *self.gate.counts().strangers.entry(self.address).or_default() += 1;
        }
        self.occupied.store(false, Ordering::Relaxed);
    }

    /// A message of so many bytes was in order: what it took is given back, and what goes with it.
    pub(super) fn earn(&self, bytes: usize) {
        let most = self.most.load(Ordering::Relaxed);
        // A frame of HTTP/2 takes less than its content again.
        let earned = bytes.saturating_mul(2).saturating_add(limits::OVERHEAD_BYTES);
        let earn = |left: usize| Some(left.saturating_add(earned).min(most));
        let _ = self.allowance.fetch_update(Ordering::Relaxed, Ordering::Relaxed, earn);
    }

    /// It has sent so many bytes; false if that is too much.
    fn spend(&self, bytes: usize) -> bool {
        self.allowance.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |left| left.checked_sub(bytes)).is_ok()
    }

    /// Bytes that have come from it.
    pub(super) fn read(&self) -> u64 {
        self.read.load(Ordering::Relaxed)
    }

    /// Bytes that have gone to it.
    pub(super) fn written(&self) -> u64 {
        self.written.load(Ordering::Relaxed)
    }

    /// Counts and tells that this connection, or a request, was refused.
    pub(super) fn refuse(&self, reason: &'static str, why: &str) {
        metrics::connection_refused(reason);
        self.gate.complain(self.address, why);
    }

    /// Counts and tells that a session was refused or ended.
    pub(super) fn refuse_session(&self, reason: &'static str, why: &str) {
        metrics::session_refused(reason);
        self.gate.complain(self.address, why);
    }

    /// It did what no honest actor does, and pays for it.
    pub(super) fn fine(&self) {
        let now = Instant::now();
        if let Some(bucket) = self.gate.counts().attempts(self.address, now) {
            bucket.drain(limits::OFFENCE_ATTEMPTS, now);
        }
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
    /// Since when it takes nothing of what is written to it.
    unread: Option<Instant>,
    /// Bytes of the preface that have come.
    begun: usize,
}

trait Duplex: AsyncRead + AsyncWrite + Send + Unpin {}
impl<T: AsyncRead + AsyncWrite + Send + Unpin> Duplex for T {}

impl Connected for Connection {
    type ConnectInfo = Arc<Peer>;

    fn connect_info(&self) -> Arc<Peer> {
        self.peer.clone()
    }
}

impl Connection {
    /// An error where patience with it has ended. To be asked before all else, of reads and of writes: while a peer does not
    /// read, HTTP/2 only writes.
    fn patience(&mut self, cx: &mut Context<'_>) -> io::Result<()> {
        if self.peer.expelled.load(Ordering::Relaxed) {
            return Err(io::ErrorKind::ConnectionAborted.into());
        }
        let hello = *self.peer.deadline();
        let unread = self.unread.map(|since| since + limits::SILENCE_LIMIT);
        let Some(deadline) = hello.into_iter().chain(unread).min() else { return Ok(()) };
        if self.alarm.deadline() != deadline {
            self.alarm.as_mut().reset(deadline);
        }
        if self.alarm.as_mut().poll(cx).is_pending() {
            return Ok(());
        }
        let unread = unread == Some(deadline);
        let (reason, why) = if unread { ("unread", "it does not read") } else { ("deadline", "no hello") };
        self.peer.expelled.store(true, Ordering::Relaxed);
        self.peer.refuse(reason, why);
        Err(io::ErrorKind::TimedOut.into())
    }

    /// Writes, and notes whether the peer takes anything.
    fn write<T>(
        &mut self,
        cx: &mut Context<'_>,
        write: impl FnOnce(Pin<&mut (dyn Duplex + 'static)>, &mut Context<'_>) -> Poll<io::Result<T>>,
    ) -> Poll<io::Result<T>> {
        self.patience(cx)?;
        let written = write(Pin::new(&mut *self.stream), cx);
        if written.is_ready() {
            self.unread = None;
        } else if self.unread.is_none() {
            self.unread = Some(Instant::now());
            // Sets the alarm.
            self.patience(cx)?;
        }
        written
    }

    /// Why it ends after these bytes, in a word and in a sentence.
    fn objection(&mut self, read: &[u8]) -> Option<(&'static str, &'static str)> {
        let expected = &PREFACE[self.begun..];
        let length = read.len().min(expected.len());
        if read[..length] != expected[..length] {
            return Some(("http2", "it does not speak HTTP/2"));
        }
        self.begun += length;
        if self.peer.spend(read.len()) {
            return None;
        }
        self.peer.fine();
        Some(("flood", "it sends and sends, and nothing of use"))
    }
}

impl AsyncRead for Connection {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        self.patience(cx)?;
        let before = buffer.filled().len();
        ready!(Pin::new(&mut self.stream).poll_read(cx, buffer))?;
        let read = &buffer.filled()[before..];
        self.peer.read.fetch_add(read.len() as u64, Ordering::Relaxed);
        if let Some((reason, why)) = self.objection(read) {
            self.peer.expelled.store(true, Ordering::Relaxed);
            self.peer.refuse(reason, why);
            return Poll::Ready(Err(io::ErrorKind::InvalidData.into()));
        }
        Poll::Ready(Ok(()))
    }
}

impl AsyncWrite for Connection {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let written = ready!(self.write(cx, |stream, cx| stream.poll_write(cx, bytes)))?;
        self.peer.written.fetch_add(written as u64, Ordering::Relaxed);
        Poll::Ready(Ok(written))
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        parts: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let written = ready!(self.write(cx, |stream, cx| stream.poll_write_vectored(cx, parts)))?;
        self.peer.written.fetch_add(written as u64, Ordering::Relaxed);
        Poll::Ready(Ok(written))
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.write(cx, AsyncWrite::poll_flush)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.write(cx, AsyncWrite::poll_shutdown)
    }
}

/// Accepts connections until nobody takes them any more.
pub(super) async fn accept(
    mut incoming: TcpIncoming,
    tls: Option<Reloaded<ServerConfig>>,
    gate: Arc<Gate>,
    accepted: mpsc::Sender<io::Result<Connection>>,
) {
    let mut told: Option<Instant> = None;
    while let Some(stream) = tokio::select! {
        stream = incoming.next() => stream,
        () = accepted.closed() => None,
    } {
        let stream = match stream {
            Ok(stream) => stream,
            Err(error) => {
                // Out of descriptors, most likely; some will be free again.
                if told.is_none_or(|told| told.elapsed() >= COMPLAINT_INTERVAL) {
                    warn!("cannot accept a connection: {error} (not told again for a minute)");
                    told = Some(Instant::now());
                }
                tokio::time::sleep(Duration::from_millis(100)).await;
                continue;
            }
        };
        let address = stream.peer_addr().map_or(IpAddr::V4(Ipv4Addr::UNSPECIFIED), |peer| origin(peer.ip()));
        let Some(peer) = gate.admit(address) else { continue };
        let acceptor = tls.as_ref().map(|tls| TlsAcceptor::from(tls.get()));
        let accepted = accepted.clone();
        tokio::spawn(async move {
            if let Some(stream) = greet(stream, acceptor, &peer).await {
                let alarm = Box::pin(sleep_until(Instant::now() + limits::HELLO_DEADLINE));
                // Nobody takes it if the service is ending.
                let _ = accepted.send(Ok(Connection { stream, peer, alarm, unread: None, begun: 0 })).await;
            }
        });
    }
}

/// Lets this process have as many descriptors, or as many as the system allows; returns how many.
fn descriptors(wanted: usize) -> usize {
    let Rlimit { current, maximum } = getrlimit(Resource::Nofile);
    // `None`: without limit.
    let possible = maximum.map_or(wanted as u64, |most| most.min(wanted as u64));
    if current.is_some_and(|current| current < possible) {
        let raised = Rlimit { current: Some(possible), maximum };
        if let Err(error) = setrlimit(Resource::Nofile, raised) {
            warn!("cannot raise the limit on descriptors: {error}");
            return current.unwrap_or(possible) as usize;
        }
    }
    possible as usize
}

/// Whom an address stands for: with IPv6, everyone has a network of 2^64 of them.
fn origin(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V6(address) => IpAddr::V6(Ipv6Addr::from_bits(address.to_bits() >> 64 << 64)),
        address @ IpAddr::V4(_) => address,
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

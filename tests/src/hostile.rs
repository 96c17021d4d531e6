//! A client that speaks the protocol, and lies: HTTP/2 and gRPC by hand, so that everything can be wrong.

use std::future::poll_fn;
use std::io;
use std::net::{Ipv4Addr, SocketAddr};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use bytes::{Bytes, BytesMut};
use h2::client::SendRequest;
use h2::{Reason, RecvStream, SendStream};
use http::{HeaderMap, Request};
use popgym_proto::{
    ActorMessage, Fingerprint, Hello, LearnerMessage, Leases, OpenEpoch, PROTOCOL_VERSION, RunSpec, transport, wire,
};
use prost::Message as _;
use socket2::SockRef;
use tokio::io::Interest;
use tokio::net::{TcpSocket, TcpStream};
use tokio::sync::{mpsc, oneshot, watch};
use tokio::task::JoinHandle;
use tonic::{Response, Status, Streaming};

use crate::{DEADLINE, Process};

/// The path of the only call.
pub const SESSION: &str = "/popgym.v1.Learner/Session";

/// A TCP connection to `address` from an address of this machine, so that each kind of client has limits of its own.
///
/// # Errors
/// As the system says.
pub async fn connect(address: SocketAddr, from: Ipv4Addr) -> io::Result<TcpStream> {
    let socket = TcpSocket::new_v4()?;
    socket.bind((from, 0).into())?;
    socket.connect(address).await
}

/// Connects, asks for more answers than there is room for on the way, and reads none of them.
///
/// # Errors
/// The system refuses the socket, or its options.
pub async fn deaf(address: SocketAddr, from: Ipv4Addr) -> io::Result<TcpStream> {
    let socket = TcpSocket::new_v4()?;
    // With both, the learner's own side of the connection is small too.
    socket.set_recv_buffer_size(1)?;
    SockRef::from(&socket).set_tcp_mss(100)?;
    socket.bind((from, 0).into())?;
    let stream = socket.connect(address).await?;
    let pings = [PREFACE, &frame(6, 0, 0, &[7; 8]).repeat(3700)].concat();
    let mut sent = 0;
    while sent < pings.len() {
        // The learner takes no more while it cannot answer.
        let Ok(writable) = tokio::time::timeout(Duration::from_secs(1), stream.writable()).await else { break };
        writable?;
        match stream.try_write(&pings[sent..]) {
            Ok(written) => sent += written,
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
            Err(error) => return Err(error),
        }
    }
    Ok(stream)
}

/// A connection of HTTP/2; it ends with this value.
#[derive(Debug)]
pub struct Connection {
    requests: SendRequest<Bytes>,
    window: watch::Sender<u32>,
    driver: JoinHandle<Result<(), h2::Error>>,
}

impl Drop for Connection {
    fn drop(&mut self) {
        self.driver.abort();
    }
}

impl Connection {
    /// Connects; the learner may have `window` bytes of each stream on the way.
    ///
    /// # Errors
    /// As the system or the learner says.
    pub async fn open(address: SocketAddr, from: Ipv4Addr, window: u32) -> io::Result<Self> {
        let stream = connect(address, from).await?;
        let mut builder = h2::client::Builder::new();
        builder.initial_window_size(window).initial_connection_window_size(1 << 24).max_send_buffer_size(1 << 20);
        let (requests, mut connection) = builder.handshake(stream).await.map_err(io::Error::other)?;
        let (window, mut resized) = watch::channel(window);
        let driver = tokio::spawn(async move {
            loop {
                tokio::select! {
                    end = &mut connection => return end,
                    Ok(()) = resized.changed() => connection.set_initial_window_size(*resized.borrow())?,
                }
            }
        });
        Ok(Self { requests, window, driver })
    }

    /// Whether it has ended.
    pub fn is_over(&self) -> bool {
        self.driver.is_finished()
    }

    /// Lets the learner have so many bytes of each stream on the way.
    pub fn widen(&self, window: u32) {
        // Fails only for a connection that has ended.
        let _ = self.window.send(window);
    }

    /// Begins a call with these headers besides the usual.
    ///
    /// # Errors
    /// The connection has ended.
    pub async fn call(&self, path: &str, headers: HeaderMap) -> Result<Session, h2::Error> {
        let mut requests = self.requests.clone().ready().await?;
        let mut request = Request::post(format!("http://learner{path}"));
        if let Some(all) = request.headers_mut() {
            all.extend(headers);
        }
        let request = request.header("content-type", "application/grpc").header("te", "trailers").body(());
        let (answer, out) = requests.send_request(request.expect("a request"), false)?;
        Ok(Session { out, reader: Reader { answer: Some(answer), stream: None, buffer: BytesMut::new() } })
    }

    /// Begins a session.
    ///
    /// # Errors
    /// The connection has ended.
    pub async fn session(&self) -> Result<Session, h2::Error> {
        self.call(SESSION, HeaderMap::new()).await
    }
}

/// One call.
#[derive(Debug)]
pub struct Session {
    /// What goes to the learner.
    pub out: SendStream<Bytes>,
    /// What comes from it.
    pub reader: Reader,
}

impl Session {
    /// Sends a message as the protocol has it.
    ///
    /// # Errors
    /// The stream has ended.
    pub async fn send(&mut self, message: ActorMessage) -> Result<(), h2::Error> {
        self.send_wire(message.into_wire()).await
    }

    /// Sends any message.
    ///
    /// # Errors
    /// The stream has ended.
    pub async fn send_wire(&mut self, message: wire::FromActor) -> Result<(), h2::Error> {
        self.send_bytes(&message.encode_to_vec()).await
    }

    /// Sends anything as the content of a message.
    ///
    /// # Errors
    /// The stream has ended.
    pub async fn send_bytes(&mut self, content: &[u8]) -> Result<(), h2::Error> {
        self.send_raw(framed(content).into()).await
    }

    /// Sends anything at all.
    ///
    /// # Errors
    /// The stream has ended.
    pub async fn send_raw(&mut self, mut bytes: Bytes) -> Result<(), h2::Error> {
        while !bytes.is_empty() {
            self.out.reserve_capacity(bytes.len());
            let room = poll_fn(|cx| self.out.poll_capacity(cx)).await.unwrap_or(Err(Reason::CANCEL.into()))?;
            self.out.send_data(bytes.split_to(room.min(bytes.len())), false)?;
        }
        Ok(())
    }

    /// Says hello and, if it is welcome, that it is ready.
    ///
    /// # Errors
    /// The status with which it is refused.
    pub async fn join(&mut self, hello: Hello, fingerprint: Fingerprint) -> Result<RunSpec, Status> {
        let lost = |error: h2::Error| Status::unavailable(error.to_string());
        self.send(ActorMessage::Hello(hello)).await.map_err(lost)?;
        let LearnerMessage::Welcome(spec) = self.reader.next().await? else {
            return Err(Status::unknown("no welcome"));
        };
        self.send(ActorMessage::Ready(fingerprint)).await.map_err(lost)?;
        Ok(spec)
    }

    /// Reads on until it holds at least `count` leases of one epoch.
    ///
    /// # Errors
    /// The status with which the session ends before that.
    pub async fn held(&mut self, count: usize) -> Result<(OpenEpoch, Leases), Status> {
        let (mut open, mut leases) = (None, Leases { epoch: 0, episodes: Vec::new() });
        loop {
            match self.reader.next().await? {
                LearnerMessage::Epoch(epoch) => {
                    leases = Leases { epoch: epoch.epoch, episodes: Vec::new() };
                    open = Some(epoch);
                }
                LearnerMessage::Leases(more) => leases.episodes.extend(more.episodes),
                LearnerMessage::Stop { reason } => return Err(Status::ok(reason)),
                _ => {}
            }
            if let Some(open) = open.take_if(|_| leases.episodes.len() >= count) {
                return Ok((open, leases));
            }
        }
    }
}

/// The near end of a call.
#[derive(Debug)]
pub struct Reader {
    answer: Option<h2::client::ResponseFuture>,
    stream: Option<RecvStream>,
    buffer: BytesMut,
}

impl Reader {
    /// The learner's next message.
    ///
    /// # Errors
    /// The status with which the learner ends the call; `Unavailable` where the connection ends without one.
    ///
    /// # Panics
    /// Past the deadline, or if the learner sends what is no message.
    pub async fn next(&mut self) -> Result<LearnerMessage, Status> {
        let message = tokio::time::timeout(DEADLINE, self.read()).await.expect("a word in time")?;
        let message = wire::FromLearner::decode(message).expect("a message");
        Ok(LearnerMessage::from_wire(message).expect("a legal message"))
    }

    /// Reads on to the end of the call: the status.
    pub async fn end(&mut self) -> Status {
        loop {
            if let Err(status) = self.next().await {
                return status;
            }
        }
    }

    async fn read(&mut self) -> Result<Bytes, Status> {
        let lost = |error: h2::Error| Status::unavailable(error.to_string());
        if let Some(answer) = self.answer.take() {
            let answer = answer.await.map_err(lost)?;
            if let Some(status) = Status::from_header_map(answer.headers()) {
                return Err(status);
            }
            if !answer.status().is_success() {
                return Err(Status::unavailable(answer.status().to_string()));
            }
            self.stream = Some(answer.into_body());
        }
        let Some(stream) = &mut self.stream else { return Err(Status::unavailable("it has ended")) };
        loop {
            if let Some(&[_, a, b, c, d]) = self.buffer.first_chunk() {
                let length = 5 + u32::from_be_bytes([a, b, c, d]) as usize;
                if self.buffer.len() >= length {
                    return Ok(self.buffer.split_to(length).split_off(5).freeze());
                }
            }
            let Some(data) = stream.data().await else {
                let trailers = stream.trailers().await.map_err(lost)?.unwrap_or_default();
                return Err(Status::from_header_map(&trailers).unwrap_or(Status::unavailable("no status")));
            };
            let data = data.map_err(lost)?;
            stream.flow_control().release_capacity(data.len()).map_err(lost)?;
            self.buffer.extend_from_slice(&data);
        }
    }
}

/// A message in its gRPC frame.
pub fn framed(content: &[u8]) -> Vec<u8> {
    let length = u32::try_from(content.len()).expect("less than 4 GiB");
    [&[0], &length.to_be_bytes()[..], content].concat()
}

/// A hello in order.
pub fn hello(actor: &str, slots: u32) -> Hello {
    Hello {
        protocol_version: PROTOCOL_VERSION,
        build: "0.0.0".to_owned(),
        actor: actor.to_owned(),
        key: 0,
        incarnation: 1,
        slots,
        run: None,
    }
}

/// A learner that asks an actor for its fingerprint, and has no more to say.
struct Curious {
    spec: RunSpec,
    told: Arc<Mutex<Option<oneshot::Sender<Fingerprint>>>>,
}

#[tonic::async_trait]
impl wire::learner_server::Learner for Curious {
    type SessionStream = tokio_stream::wrappers::ReceiverStream<Result<wire::FromLearner, Status>>;

    async fn session(
        &self,
        request: tonic::Request<Streaming<wire::FromActor>>,
    ) -> Result<Response<Self::SessionStream>, Status> {
        let (replies, stream) = mpsc::channel(2);
        let welcome = LearnerMessage::Welcome(self.spec.clone()).into_wire();
        replies.send(Ok(welcome)).await.map_err(|_| Status::internal("no stream"))?;
        let (mut requests, told) = (request.into_inner(), self.told.clone());
        tokio::spawn(async move {
            while let Ok(Some(message)) = requests.message().await {
                if let Some(wire::from_actor::Message::Ready(ready)) = message.message {
                    let told = told.lock().unwrap_or_else(PoisonError::into_inner).take();
                    let fingerprint = Fingerprint::try_from(&ready.fingerprint[..]);
                    let _ = told.zip(fingerprint.ok()).map(|(told, fingerprint)| told.send(fingerprint));
                }
            }
            drop(replies);
        });
        Ok(Response::new(stream.into()))
    }
}

/// The fingerprint that an actor tells whoever says that this is the run: with it, a liar gets as far as leases.
///
/// # Panics
/// If the actor does not tell it in time.
pub async fn fingerprint(spec: RunSpec, actor: impl FnOnce(&str) -> Process) -> Fingerprint {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let url = format!("http://{}", listener.local_addr().expect("its address"));
    let (told, fingerprint) = oneshot::channel();
    let learner = transport::service(Curious { spec, told: Arc::new(Mutex::new(Some(told))) });
    let server = transport::server().add_service(learner).serve_with_incoming(transport::incoming(listener));
    let server = tokio::spawn(server);
    let _actor = actor(&url);
    let fingerprint = tokio::time::timeout(DEADLINE, fingerprint).await.expect("in time").expect("a fingerprint");
    server.abort();
    fingerprint
}

/// Waits until the learner has closed this connection; what it says until then is of no interest.
///
/// # Panics
/// Past the deadline.
pub async fn closed(stream: &TcpStream) {
    let closed = async {
        let mut buffer = [0; 4096];
        loop {
            if stream.readable().await.is_err() {
                return;
            }
            match stream.try_read(&mut buffer) {
                Ok(0) => return,
                Err(error) if error.kind() != io::ErrorKind::WouldBlock => return,
                _ => {}
            }
        }
    };
    tokio::time::timeout(DEADLINE, closed).await.expect("the end of a connection");
}

/// How HTTP/2 begins: the preface and empty settings.
pub const PREFACE: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\x04\0\0\0\0\0";

/// Begins with HTTP/2, then writes `bytes` again and again, with all its might, until the learner closes the connection.
///
/// # Panics
/// Past the deadline.
pub async fn flood(stream: &TcpStream, bytes: &[u8]) {
    let flood = async {
        let (bytes, mut sent) = ([PREFACE, &bytes.repeat(1000)].concat(), 0);
        loop {
            if stream.ready(Interest::READABLE | Interest::WRITABLE).await.is_err() {
                return;
            }
            // What is read makes room for more answers, or tells of the end.
            if matches!(stream.try_read(&mut [0; 4096]), Ok(0)) {
                return;
            }
            match stream.try_write(&bytes[sent..]) {
                Ok(written) if sent + written == bytes.len() => sent = PREFACE.len(),
                Ok(written) => sent += written,
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                Err(_) => return,
            }
        }
    };
    tokio::time::timeout(DEADLINE, flood).await.expect("the end of a flood");
}

/// A frame of HTTP/2.
pub fn frame(kind: u8, flags: u8, stream: u32, content: &[u8]) -> Vec<u8> {
    let length = u32::try_from(content.len()).expect("a short frame").to_be_bytes();
    [&length[1..], &[kind, flags], &stream.to_be_bytes(), content].concat()
}

/// Sends a heartbeat as often as an honest actor does, until the session ends.
pub async fn stay_alive(out: &mut SendStream<Bytes>) {
    let heartbeat = Bytes::from(framed(&ActorMessage::Heartbeat.into_wire().encode_to_vec()));
    while out.send_data(heartbeat.clone(), false).is_ok() {
        tokio::time::sleep(Duration::from_secs(5)).await;
    }
}

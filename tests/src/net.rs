//! A free port, a plain HTTP request, the health service, a network that can be cut and stalled, and a learner that refuses.

use std::io::{self, Read as _, Write as _};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use popgym_proto::{ActorMessage, Hello, LearnerMessage, transport, wire};
use tonic::{Request, Response, Status, Streaming};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;

use crate::{DEADLINE, POLL_INTERVAL, until};

/// An address on this machine that nobody listens on.
///
/// # Panics
/// If the system has none.
pub fn free_address() -> String {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
    listener.local_addr().expect("its address").to_string()
}

/// The body of `GET path` at `address`, asked again until it contains all of `expected`.
///
/// # Panics
/// Past the deadline, or if an answer is not 200.
pub fn get(address: &str, path: &str, expected: &[&str]) -> String {
    until(&format!("{expected:?} at http://{address}{path}"), || {
        let answer = request(address, path).ok()?;
        let (head, body) = answer.split_once("\r\n\r\n").expect("an HTTP answer");
        assert!(head.starts_with("HTTP/1.1 200"), "{head}");
        expected.iter().all(|expected| body.contains(expected)).then(|| body.to_owned())
    })
}

/// The value of a counter in what Prometheus sees, 0 where it is not there.
pub fn counter(metrics: &str, name: &str) -> u64 {
    let value = metrics.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' ')?.parse().ok());
    value.unwrap_or(0)
}

/// All that is answered to `GET path` at `address`.
///
/// # Errors
/// The address is not served, or not in time.
pub fn request(address: &str, path: &str) -> io::Result<String> {
    let mut stream = TcpStream::connect(address)?;
    stream.set_read_timeout(Some(DEADLINE))?;
    write!(stream, "GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n")?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer)?;
    Ok(answer)
}

/// What the health service at `url` says of `service`.
///
/// # Panics
/// If it does not answer.
pub fn health(url: &str, service: &str) -> ServingStatus {
    runtime().block_on(async {
        let channel = transport::endpoint(url).expect("a URL").connect().await.expect("a connection");
        let request = HealthCheckRequest { service: service.to_owned() };
        let check = async { HealthClient::new(channel).check(request).await };
        let answer = tokio::time::timeout(DEADLINE, check).await.expect("an answer in time");
        answer.expect("the health service").into_inner().status()
    })
}

/// A network between actors and a learner: passes on what comes, until it is cut, and while it is not stalled.
#[derive(Debug)]
pub struct Network {
    address: SocketAddr,
    wires: Arc<Wires>,
}

#[derive(Debug, Default)]
struct Wires {
    open: Mutex<Vec<TcpStream>>,
    /// Bytes that have gone from the near end to the far end.
    sent: AtomicUsize,
    stalled: AtomicBool,
}

impl Network {
    /// A network that leads to `address`. Its threads end with the test's process.
    ///
    /// # Panics
    /// If the system refuses a socket.
    pub fn to(address: &str) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
        let network = Self { address: listener.local_addr().expect("its address"), wires: Arc::default() };
        let (wires, to) = (network.wires.clone(), address.to_owned());
        std::thread::spawn(move || {
            for near in listener.incoming().flatten() {
                // Where nobody listens, the connection is closed again.
                let Ok(far) = TcpStream::connect(&to) else { continue };
                let _ = connect(&near, &far, &wires);
            }
        });
        network
    }

    /// The URL of its near end.
    pub fn url(&self) -> String {
        format!("http://{}", self.address)
    }

    /// Bytes that it has passed on to the far end.
    pub fn sent(&self) -> usize {
        self.wires.sent.load(Ordering::SeqCst)
    }

    /// Whether what comes is held back.
    pub fn stall(&self, stalled: bool) {
        self.wires.stalled.store(stalled, Ordering::SeqCst);
    }

    /// Cuts every connection. New ones are taken.
    pub fn cut(&self) {
        for connection in self.wires.open.lock().unwrap_or_else(PoisonError::into_inner).drain(..) {
            // Fails only for one that has been closed.
            let _ = connection.shutdown(Shutdown::Both);
        }
    }
}

fn connect(near: &TcpStream, far: &TcpStream, wires: &Arc<Wires>) -> io::Result<()> {
    let mut open = wires.open.lock().unwrap_or_else(PoisonError::into_inner);
    for (from, to, counted) in [(near, far, true), (far, near, false)] {
        open.push(from.try_clone()?);
        let (mut from, mut to, wires) = (from.try_clone()?, to.try_clone()?, wires.clone());
        std::thread::spawn(move || {
            let mut buffer = vec![0; 1 << 16];
            while let Ok(length @ 1..) = from.read(&mut buffer) {
                while wires.stalled.load(Ordering::SeqCst) {
                    std::thread::sleep(POLL_INTERVAL);
                }
                wires.sent.fetch_add(if counted { length } else { 0 }, Ordering::SeqCst);
                if to.write_all(&buffer[..length]).is_err() {
                    break;
                }
            }
            let _ = to.shutdown(Shutdown::Both);
        });
    }
    Ok(())
}

/// A learner that answers every actor with one status.
#[derive(Debug)]
pub struct Refusing(pub Status);

#[tonic::async_trait]
impl wire::learner_server::Learner for Refusing {
    type SessionStream = tokio_stream::Empty<Result<wire::FromLearner, Status>>;

    async fn session(
        &self,
        _request: Request<Streaming<wire::FromActor>>,
    ) -> Result<Response<Self::SessionStream>, Status> {
        Err(self.0.clone())
    }
}

impl Refusing {
    /// Serves from a thread that ends with the test's process; returns the URL.
    ///
    /// # Panics
    /// If the system refuses a socket or a runtime.
    pub fn serve(self) -> String {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
        let url = format!("http://{}", listener.local_addr().expect("its address"));
        listener.set_nonblocking(true).expect("a socket that does not block");
        std::thread::spawn(move || {
            runtime().block_on(async {
                let incoming = transport::incoming(tokio::net::TcpListener::from_std(listener).expect("a socket"));
                transport::server().add_service(transport::service(self)).serve_with_incoming(incoming).await
            })
        });
        url
    }
}

/// What the learner at `url` answers to an actor that says this hello.
///
/// # Errors
/// The status with which it refuses.
///
/// # Panics
/// If it does not answer in time.
pub fn answer_to(url: &str, hello: Hello) -> Result<LearnerMessage, Status> {
    let answer = async {
        let mut client =
            transport::client(transport::endpoint(url).expect("a URL").connect().await.expect("a connection"));
        let requests = tokio_stream::once(ActorMessage::Hello(hello).into_wire());
        let mut replies = client.session(requests).await?.into_inner();
        let message = replies.message().await?.ok_or_else(|| Status::unknown("the stream has ended"))?;
        LearnerMessage::from_wire(message).map_err(|error| Status::unknown(error.to_string()))
    };
    runtime().block_on(async { tokio::time::timeout(DEADLINE, answer).await.expect("an answer in time") })
}

fn runtime() -> tokio::runtime::Runtime {
    tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime")
}

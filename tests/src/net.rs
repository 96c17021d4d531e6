//! A free port, a plain HTTP request, the health service.

use std::io::{Read as _, Write as _};
use std::net::{TcpListener, TcpStream};

use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;

use crate::{DEADLINE, until};

/// An address on this machine that nobody listens on.
///
/// # Panics
/// If the system has none.
pub fn free_address() -> String {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
    listener.local_addr().expect("its address").to_string()
}

/// The body of `GET path` at `address`, tried until it is answered.
///
/// # Panics
/// Past the deadline, or if the answer is not 200.
pub fn get(address: &str, path: &str) -> String {
    let answer = until(&format!("http://{address}{path}"), || request(address, path).ok());
    let (head, body) = answer.split_once("\r\n\r\n").expect("an HTTP answer");
    assert!(head.starts_with("HTTP/1.1 200"), "{head}");
    body.to_owned()
}

fn request(address: &str, path: &str) -> std::io::Result<String> {
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
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
    runtime.block_on(async {
        let channel = popgym_proto::transport::endpoint(url).expect("a URL").connect().await.expect("a connection");
        let request = HealthCheckRequest { service: service.to_owned() };
        let check = async { HealthClient::new(channel).check(request).await };
        let answer = tokio::time::timeout(DEADLINE, check).await.expect("an answer in time");
        answer.expect("the health service").into_inner().status()
    })
}

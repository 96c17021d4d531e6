//! The HTTP port of both programs: health, readiness, and the learner's page.

use popgym_tests::{Program, Scene, net};
use rustix::process::Signal;
use serde_json::Value;

/// The code of an answer, its head and its body.
fn ask(address: &str, path: &str) -> (u16, String, String) {
    let answer = net::request(address, path).expect("an answer");
    let (head, body) = answer.split_once("\r\n\r\n").expect("an HTTP answer");
    let code = head.split(' ').nth(1).and_then(|code| code.parse().ok()).expect("a status");
    (code, head.to_owned(), body.to_owned())
}

/// What the page would show, once `ready` finds it so.
fn shown(address: &str, ready: impl Fn(&Value) -> bool) -> Value {
    popgym_tests::until("the page's data", || {
        let view: Value = serde_json::from_str(&net::get(address, "/run.json", &[])).expect("JSON");
        ready(&view).then_some(view)
    })
}

#[test]
fn an_actor_is_ready_while_it_has_a_learner() {
    let scene = Scene::new();
    let (port, monitor) = (net::free_address(), net::free_address());
    let actor = scene.actor(&port, &["--metrics-listen", &monitor]);
    net::get(&monitor, "/healthz", &["alive"]);
    assert_eq!(ask(&monitor, "/readyz").0, 503);
    let mut learner = scene.train("run", &["--actors", "0", "--listen", &port, "--steps", "10000000"]);
    popgym_tests::until("an actor that is ready", || (ask(&monitor, "/readyz").0 == 200).then_some(()));
    learner.signal(Signal::TERM);
    popgym_tests::until("an actor that is not ready", || (ask(&monitor, "/readyz").0 == 503).then_some(()));
    assert_eq!(ask(&monitor, "/healthz").0, 200);
    learner.expect(0);
    drop(actor);
}

#[test]
fn the_page_shows_the_run() {
    let scene = Scene::new();
    let monitor = net::free_address();
    let flags = ["--metrics-listen", monitor.as_str(), "--steps", "10000000", "--checkpoint-epochs", "2"];
    let mut learner = scene.train("run", &flags);
    scene.reached(&mut learner, "run", 3);
    assert_eq!(ask(&monitor, "/readyz").0, 200);
    let (code, head, page) = ask(&monitor, "/");
    assert_eq!(code, 200);
    assert!(head.contains("text/html") && head.to_lowercase().contains("content-security-policy: default-src 'none'"));
    assert!(!page.contains("http://") && !page.contains("https://"), "the page loads something from elsewhere");

    let view = shown(&monitor, |view| view["actors"][0]["steps"].as_u64() > Some(0) && !view["checkpoint"].is_null());
    assert_eq!(view["run"]["env"], "popgym-RepeatPreviousEasy-v0");
    assert_eq!(view["config"].as_str().unwrap(), scene.read("run/config.toml"));
    // Each row of the table is a point of the curve: the run is short.
    let table = scene.read("run/metrics.csv");
    let curve = view["curve"].as_array().unwrap();
    assert!(curve.len() >= 3);
    for (row, point) in table.lines().skip(1).zip(curve) {
        let row: Vec<f64> = row.split(',').map(|field| field.parse().unwrap()).collect();
        let point: Vec<f64> =
            ["steps", "mean", "min", "max", "mmer"].map(|name| point[name].as_f64().unwrap()).to_vec();
        assert_eq!(point, [row[1], row[3], row[5], row[6], row[8]]);
    }
    let recent = &view["recent"];
    let part = |name: &str| recent[name].as_f64().unwrap();
    let parts = part("wait_seconds") + part("learn_seconds") + part("other_seconds");
    assert!(part("seconds") > 0.0 && (parts / part("seconds") - 1.0).abs() < 1e-9);

    let listed: Vec<&str> = view["files"].as_array().unwrap().iter().map(|name| name.as_str().unwrap()).collect();
    assert!(listed.contains(&"config.toml") && listed.contains(&"metrics.csv"), "{listed:?}");
    assert_eq!(ask(&monitor, "/files/config.toml").2, scene.read("run/config.toml"));
    for secret in ["run.json", "checkpoints", "..%2Frun%2Fconfig.toml", "%2Fetc%2Fpasswd", "events"] {
        assert_eq!(ask(&monitor, &format!("/files/{secret}")).0, 404, "{secret}");
    }
    learner.signal(Signal::TERM);
    learner.expect(0);
}

#[test]
fn the_page_of_a_resumed_run_begins_with_the_runs_beginning() {
    let scene = Scene::new();
    scene.train("run", &["--steps", "16384", "--checkpoint-epochs", "1"]).expect(0);
    let rows = scene.rows("run");
    let monitor = net::free_address();
    let mut learner = scene.resume("run", &["--steps", "10000000", "--metrics-listen", &monitor]);
    let view = shown(&monitor, |view| view["curve"].as_array().is_some_and(|curve| curve.len() > rows));
    net::get(&monitor, "/metrics", &["\npopgym_learner_run_info{", "\npopgym_learner_complete{"]);
    let first = scene.metrics("run").lines().nth(1).unwrap().split(',').nth(1).unwrap().to_owned();
    assert_eq!(view["curve"][0]["steps"].to_string(), first);
    learner.signal(Signal::TERM);
    learner.expect(0);
}

#[test]
fn a_port_that_is_taken_is_named() {
    let scene = Scene::new();
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap().to_string();
    let learner = scene.train("run", &["--metrics-listen", &address]).expect(1);
    assert!(learner.stderr.contains(&format!("cannot serve metrics at {address}: ")), "{}", learner.stderr);
    assert!(!scene.path("run").exists());
    let actor = scene.start(Program::Actor, &["--learner", "127.0.0.1:9", "--metrics-listen", &address]).expect(1);
    assert!(actor.stderr.contains(&format!("cannot serve metrics at {address}: ")), "{}", actor.stderr);
}

/// Silent connections, more than the port serves at a time, keep Prometheus waiting no longer than their deadline.
#[test]
fn silence_does_not_close_the_port() {
    let scene = Scene::new();
    let monitor = net::free_address();
    let mut learner = scene.train("run", &["--metrics-listen", &monitor, "--steps", "10000000"]);
    net::get(&monitor, "/healthz", &["alive"]);
    let silent: Vec<_> = (0..100).map(|_| std::net::TcpStream::connect(&monitor).unwrap()).collect();
    net::get(&monitor, "/metrics", &["popgym_learner_actors"]);
    drop(silent);
    learner.signal(Signal::TERM);
    learner.expect(0);
}

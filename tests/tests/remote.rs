//! Actors on other machines: how they find, serve and leave a learner; what health service and Prometheus say.

use std::io::Write as _;
use std::net::TcpStream;

use popgym_proto::{Hello, LearnerMessage, PROTOCOL_VERSION, wire};
use popgym_tests::net::{self, Network, Refusing};
use popgym_tests::{Process, Program, Scene};
use rustix::process::Signal;
use tonic::{Code, Status};
use tonic_health::pb::health_check_response::ServingStatus;

/// Flags of a learner that waits for remote actors.
const REMOTE: [&str; 4] = ["--actors", "0", "--listen", "127.0.0.1:0"];

/// A learner that waits for actors, and its URL.
fn waiting(scene: &Scene, flags: &[&str]) -> (Process, String) {
    let mut learner = scene.train("run", &[&REMOTE, flags].concat());
    let url = learner.url();
    (learner, url)
}

/// The run's id.
fn id(scene: &Scene) -> String {
    scene.json("run/run.json")["run"].as_str().unwrap().to_owned()
}

#[test]
fn actors_come_work_and_leave_by_themselves() {
    let scene = Scene::new();
    let (learner, url) = waiting(&scene, &["--steps", "16384"]);
    for service in ["", wire::learner_server::SERVICE_NAME] {
        assert_eq!(net::health(&url, service), ServingStatus::Serving, "`{service}`");
    }
    let run = id(&scene);
    let actors = ["plain", "bound", "nice"].map(|name| {
        let flags = match name {
            "bound" => &["--run", run.as_str()][..],
            "nice" => &["--nice", "5"],
            _ => &[],
        };
        (name, scene.actor(&url, &[&["--name", name], flags].concat()))
    });
    let log = learner.expect(0).stderr;
    // One that has not come before the end has nothing to leave.
    let joined = actors.into_iter().filter(|(name, _)| log.contains(&format!("actor joined actor=\"{name}\"")));
    let logs: Vec<String> = joined.map(|(_, actor)| actor.expect(0).stderr).collect();
    assert!(!logs.is_empty(), "{log}");
    for log in logs {
        assert_eq!(log.matches("run complete: the run is complete").count(), 1, "{log}");
    }
    assert_eq!(scene.accounted("run"), Scene::new().curve("local", &["--steps", "16384"]));
}

#[test]
fn an_actor_may_be_there_before_its_learner() {
    let scene = Scene::new();
    let address = net::free_address();
    let mut actor = scene.actor(&address, &[]);
    actor.logged(&format!("no learner at http://{address}"));
    let learner = scene.train("run", &["--actors", "0", "--listen", &address]);
    actor.expect(0);
    learner.expect(0);
    // The same again, as whatever starts both may do: there is nothing left for either.
    let actor = scene.actor(&address, &[]);
    let learner = scene.train("run", &["--actors", "0", "--listen", &address, "--continue"]);
    actor.expect(0);
    let outcome = learner.expect(0);
    assert!(outcome.stdout.contains("already complete"), "{}", outcome.stdout);
}

#[test]
fn an_actor_stays_where_the_learner_was_interrupted() {
    let scene = Scene::new();
    let (mut learner, url) = waiting(&scene, &["--steps", "16384"]);
    let mut actor = scene.actor(&url, &[]);
    scene.reached(&mut learner, "run", 3);
    learner.signal(Signal::INT);
    learner.expect(130);
    actor.logged("no learner at");
    let resumed = scene.resume("run", &["--listen", url.trim_start_matches("http://")]);
    actor.expect(0);
    resumed.expect(0);
    assert_eq!(scene.accounted("run"), Scene::new().curve("undisturbed", &["--steps", "16384"]));
}

#[test]
fn who_is_refused_is_told_why_and_the_run_goes_on() {
    let scene = Scene::new();
    let (learner, url) = waiting(&scene, &[]);
    let hello = |protocol_version: u32, run: Option<&str>| Hello {
        protocol_version,
        build: "0.0.0".to_owned(),
        actor: "stranger".to_owned(),
        key: 1,
        incarnation: 1,
        slots: 16,
        run: run.map(str::to_owned),
    };
    let refusal = net::answer_to(&url, hello(PROTOCOL_VERSION + 1, None)).unwrap_err();
    assert_eq!(refusal.code(), Code::FailedPrecondition);
    assert!(refusal.message().contains(&format!("speaks protocol version {}", PROTOCOL_VERSION + 1)), "{refusal}");
    let refusal = net::answer_to(&url, hello(PROTOCOL_VERSION, Some("another"))).unwrap_err();
    assert!(refusal.message().contains("for the run another"), "{refusal}");
    // Who does not speak the protocol at all.
    let address = url.trim_start_matches("http://");
    for rubbish in [&b"GET / HTTP/1.1\r\n\r\n"[..], &[0xff; 4096], b""] {
        let _ = TcpStream::connect(address).unwrap().write_all(rubbish);
    }
    // The right one is welcome, and told what to do; then it goes without a word.
    let run = id(&scene);
    match net::answer_to(&url, hello(PROTOCOL_VERSION, Some(&run))) {
        Ok(LearnerMessage::Welcome(spec)) => assert_eq!(spec.run, run),
        other => panic!("{other:?}"),
    }
    scene.actor(&url, &[]).expect(0);
    learner.expect(0);
    assert_eq!(scene.accounted("run"), Scene::new().curve("local", &[]));
}

/// The only error of an actor that fails.
#[track_caller]
fn assert_fails(actor: Process, reason: &str) {
    let outcome = actor.expect(1);
    let errors: Vec<&str> = outcome.stderr.lines().filter(|line| line.starts_with("error: ")).collect();
    assert!(matches!(errors[..], [error] if error.contains(reason)), "`{reason}`, once: {}", outcome.stderr);
    assert!(!outcome.stderr.contains('\u{1b}'), "colours are for terminals: {:?}", outcome.stderr);
}

#[test]
fn an_actor_says_why_it_fails() {
    let scene = Scene::new();
    let (_learner, url) = waiting(&scene, &[]);
    assert_fails(scene.actor(&url, &["--run", "another"]), "the actor is for the run another");
    let nobody = net::free_address();
    assert_fails(scene.actor(&nobody, &["--retry-seconds", "1"]), &format!("no learner at http://{nobody} within 1 s"));
    let newer =
        Refusing(Status::failed_precondition("the actor speaks protocol version 1, the learner speaks 2")).serve();
    assert_fails(scene.actor(&newer, &[]), "refused by the learner: the actor speaks protocol version 1");
    let other = Refusing(Status::unimplemented("")).serve();
    assert_fails(scene.actor(&other, &[]), "not a learner of popgym-rs");
    let busy = Refusing(Status::unavailable("full")).serve();
    assert_fails(scene.actor(&busy, &["--retry-seconds", "1"]), "full");
    assert_fails(scene.actor(&url, &["--metrics-listen", url.trim_start_matches("http://")]), "cannot serve metrics");
}

#[test]
fn two_actors_of_one_name_are_two_actors() {
    let scene = Scene::new();
    let (mut learner, url) = waiting(&scene, &["--steps", "16384"]);
    let mut older = scene.actor(&url, &["--name", "twin"]);
    scene.reached(&mut learner, "run", 2);
    // So that the run does not end before the newer is there.
    older.signal(Signal::STOP);
    let newer = scene.actor(&url, &["--name", "twin"]);
    learner.logged("actor returned actor=\"twin#2\"");
    older.signal(Signal::CONT);
    older.expect(0);
    newer.expect(0);
    assert!(!learner.expect(0).stderr.contains("connected anew"));
    assert_eq!(scene.accounted("run"), Scene::new().curve("local", &["--steps", "16384"]));
}

#[test]
fn an_actor_with_a_parent_ends_with_it() {
    let scene = Scene::new();
    let nobody = net::free_address();
    // Standard input is empty, as that of a process whose parent has died.
    scene.actor(&nobody, &["--with-parent"]).expect(0);
}

#[test]
fn prometheus_watches_both_sides() {
    let scene = Scene::new();
    let (learner_metrics, actor_metrics) = (net::free_address(), net::free_address());
    // A port alone is one of this machine.
    let port = |address: &str| address.trim_start_matches("127.0.0.1:").to_owned();
    let (learner_port, actor_port) = (port(&learner_metrics), port(&actor_metrics));
    let (mut learner, url) = waiting(&scene, &["--metrics-listen", &learner_port, "--steps", "1000000"]);
    let mut actor = scene.actor(&url, &["--metrics-listen", &actor_port]);
    scene.reached(&mut learner, "run", 3);
    let text =
        net::get(&learner_metrics, "/metrics", &["popgym_learner_leases_outstanding", "popgym_learner_return_mmer "]);
    for name in [
        "run_info{env=\"popgym-RepeatPreviousEasy-v0\",memory=\"gru\",preset=\"quick\",seed=\"0\"} 1",
        "steps_per_second ",
        "env_steps_total ",
        "run_steps ",
        "episodes_total ",
        "epochs_total ",
        "weights_version ",
        "return_mean ",
        "collect_seconds",
        "activity_seconds_total{activity=\"waiting\"} ",
        "activity_seconds_total{activity=\"learning\"} ",
        "passes_total ",
        "checkpoint_timestamp_seconds ",
        "disk_free_bytes ",
        "steps_accepted_total ",
        "event_queue ",
        "received_bytes_total ",
        "sent_bytes_total ",
        "surplus_steps_total ",
        "actors 1",
    ] {
        assert!(text.contains(&format!("\npopgym_learner_{name}")), "{name}\n{text}");
    }
    let names = ["steps_total ", "episodes_total ", "sent_bytes_total ", "weights_version ", "epoch ", "live_rows "];
    let names = names.map(|name| format!("\npopgym_actor_{name}"));
    let text = net::get(&actor_metrics, "/metrics", &names.each_ref().map(String::as_str));
    let activities = text.matches("\npopgym_actor_activity_seconds_total{activity=").count();
    assert!(activities >= 3, "where time goes: {text}");
    assert!(text.contains("# TYPE popgym_actor_activity_seconds_total counter"));
    assert!(text.contains("\nprocess_resident_memory_bytes "));
    assert!(learner.is_running() && actor.is_running());
}

#[test]
fn an_episode_is_small_on_the_wire() {
    let scene = Scene::new();
    let (learner, url) = waiting(&scene, &["--steps", "16384"]);
    let network = Network::to(url.trim_start_matches("http://"));
    let actor = scene.actor(&network.url(), &[]);
    learner.expect(0);
    actor.expect(0);
    let steps = scene.json("run/summary.json")["env_steps"].as_u64().unwrap();
    let bytes = network.sent() as f64 / steps as f64;
    // All that an actor sends: episodes, handshake, heartbeats, frames, and what TCP's payload is otherwise.
    assert!((13.0..40.0).contains(&bytes), "{bytes} bytes a step");
}

#[test]
fn a_missing_actor_is_named() {
    // A copy of the learner without an actor beside it, as after an incomplete build.
    let scene = Scene::new();
    std::fs::create_dir_all(scene.path("target/release")).unwrap();
    let lonely = scene.path("target/release/learner");
    std::fs::copy(Program::Learner.path(), &lonely).unwrap();
    let libraries = Program::Learner.path().ancestors().nth(3).unwrap().join(".libtorch");
    std::os::unix::fs::symlink(libraries, scene.path(".libtorch")).unwrap();
    let mut command = std::process::Command::new(lonely);
    command.args(["train", "--config", "tiny.toml", "--out", "run"]).current_dir(scene.path("."));
    let outcome = Process::start("a lonely learner", command).expect(1);
    assert!(outcome.stderr.starts_with("error: ") && outcome.stderr.lines().count() == 1, "{}", outcome.stderr);
    assert!(outcome.stderr.contains("make build") && outcome.stderr.contains("actor"), "{}", outcome.stderr);
}

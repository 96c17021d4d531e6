//! Who may be an actor: TLS, certificates, the token; what strangers are told, and what nobody is.

use std::io::Read as _;
use std::net::TcpStream;
use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;
use std::process::Command;
use std::time::Instant;

use popgym_tests::{Authority, Process, Scene, net, until};

const TOKEN: &str = "correct-horse-battery-staple";
/// A learner that lets in who has a certificate of `ca.pem` and the token.
const LEARNER: [&str; 12] = [
    "--actors",
    "0",
    "--listen",
    "127.0.0.1:0",
    "--token-file",
    "token",
    "--tls-certificate",
    "learner.pem",
    "--tls-key",
    "learner.key",
    "--tls-client-ca",
    "ca.pem",
];
/// An actor that has both.
const ACTOR: [&str; 8] =
    ["--token-file", "token", "--tls-ca", "ca.pem", "--tls-certificate", "actor.pem", "--tls-key", "actor.key"];

/// All files of a cluster, and those of a stranger.
fn cluster() -> (Scene, Authority) {
    let (scene, authority, stranger) = (Scene::new(), Authority::new(), Authority::new());
    authority.write(&scene, "ca.pem");
    authority.issue(&scene, "learner");
    authority.issue(&scene, "actor");
    stranger.write(&scene, "stranger-ca.pem");
    stranger.issue(&scene, "stranger");
    scene.write("token", &format!("{TOKEN}\n"));
    scene.write("stranger-token", "incorrect-horse-battery-staple");
    (scene, authority)
}

/// `flags` with another value after one of them.
fn with<'a>(flags: &[&'a str], flag: &str, value: &'a str) -> Vec<&'a str> {
    let at = flags.iter().position(|&given| given == flag).unwrap();
    let mut flags = flags.to_vec();
    flags[at + 1] = value;
    flags
}

/// `flags` without one of them and its value.
fn without<'a>(flags: &[&'a str], flag: &str) -> Vec<&'a str> {
    let at = flags.iter().position(|&given| given == flag).unwrap();
    [&flags[..at], &flags[at + 2..]].concat()
}

#[test]
fn those_who_belong_here_get_the_same_curve() {
    let (scene, _) = cluster();
    let mut learner = scene.train("run", &LEARNER);
    let url = learner.url();
    assert!(url.starts_with("https://"), "{url}");
    scene.actor(&url, &ACTOR).expect(0);
    learner.expect(0);
    let undisturbed = Scene::new().curve("plain", &[]);
    assert_eq!(scene.accounted("run"), undisturbed);
    // Local actors, which have no certificate, and the token.
    scene.train("local", &with(&LEARNER, "--actors", "1")).expect(0);
    assert_eq!(scene.accounted("local"), undisturbed);
    // Who evaluates needs none of the files.
    std::fs::remove_file(scene.path("token")).unwrap();
    std::fs::remove_file(scene.path("learner.key")).unwrap();
    scene.learner(&["eval", "local", "--episodes", "8"]).expect(0);
}

fn assert_stays_out(actor: Process, code: i32, reason: &str) {
    let outcome = actor.expect(code);
    assert!(outcome.stderr.contains(reason), "`{reason}`: {}", outcome.stderr);
    assert!(!outcome.stderr.contains("horse"), "{}", outcome.stderr);
}

#[test]
fn strangers_are_refused_counted_and_told_of_once() {
    let (scene, _) = cluster();
    let begun = Instant::now();
    let metrics = net::free_address();
    let mut learner = scene.train("run", &[&LEARNER[..], &["--metrics-listen", &metrics]].concat());
    let url = learner.url();
    let address = url.trim_start_matches("https://");
    let actor = |flags: &[&str]| scene.actor(&url, &[flags, &["--retry-seconds", "0"]].concat());
    assert_stays_out(actor(&without(&ACTOR, "--token-file")), 1, "no token was shown");
    assert_stays_out(actor(&with(&ACTOR, "--token-file", "stranger-token")), 1, "the token is not the learner's");
    // Without a certificate, and with one of another authority: TLS 1.3 tells a client only after its own handshake.
    let bare = without(&without(&ACTOR, "--tls-certificate"), "--tls-key");
    assert_stays_out(actor(&bare), 1, "no learner at");
    let stranger = with(&with(&ACTOR, "--tls-certificate", "stranger.pem"), "--tls-key", "stranger.key");
    assert_stays_out(actor(&stranger), 1, "no learner at");
    // The learner itself is not who it should be.
    assert_stays_out(actor(&with(&ACTOR, "--tls-ca", "stranger-ca.pem")), 1, "no learner at");
    // Plain text, and nothing at all.
    let plain = scene.actor(&format!("http://{address}"), &["--token-file", "token", "--retry-seconds", "0"]);
    assert_stays_out(plain, 1, "no learner at");
    let mut silent = TcpStream::connect(address).unwrap();
    until("the end of a silent connection", || (silent.read(&mut [0]).unwrap_or(0) == 0).then_some(()));

    let seen = net::get(&metrics, "/metrics", &["popgym_learner_connections_refused_total"]);
    let refused =
        |reason| net::counter(&seen, &format!("popgym_learner_connections_refused_total{{reason=\"{reason}\"}}"));
    assert_eq!(refused("token"), 2, "{seen}");
    assert!(refused("tls") >= 4, "{seen}");
    assert_eq!(net::counter(&seen, "popgym_learner_sessions_total"), 0);
    let log = learner.stderr();
    let (told, minutes) = (log.matches("refused 127.0.0.1: ").count() as u64, begun.elapsed().as_secs() / 60);
    assert!((1..=1 + minutes).contains(&told), "once a minute: {log}");

    // Who belongs here is not kept out by them, and no secret is anywhere.
    let mut right = scene.actor(&url, &ACTOR);
    for process in [&mut learner, &mut right] {
        let command = std::fs::read(format!("/proc/{}/cmdline", process.id())).unwrap_or_default();
        assert!(!String::from_utf8_lossy(&command).contains("horse"));
    }
    for text in [right.expect(0).stderr, learner.expect(0).stderr, seen] {
        assert!(!text.contains("horse") && !text.contains("PRIVATE KEY"), "{text}");
    }
    let mut paths = vec![scene.path("run")];
    while let Some(path) = paths.pop() {
        if path.is_dir() {
            paths.extend(std::fs::read_dir(&path).unwrap().map(|entry| entry.unwrap().path()));
        } else {
            let text = String::from_utf8_lossy(&std::fs::read(&path).unwrap()).into_owned();
            assert!(!text.contains("horse") && !text.contains("PRIVATE KEY"), "{}", path.display());
        }
    }
    assert_eq!(scene.accounted("run"), Scene::new().curve("plain", &[]));
}

#[test]
fn replaced_files_are_used() {
    let (scene, _) = cluster();
    let mut learner = scene.train("run", &LEARNER);
    let url = learner.url();
    // Another authority, other keys, another token: as if all of them had expired.
    let renewed = Authority::new();
    renewed.write(&scene, "new-ca.pem");
    renewed.issue(&scene, "learner");
    renewed.issue(&scene, "new-actor");
    std::fs::copy(scene.path("new-ca.pem"), scene.path("ca.pem")).unwrap();
    scene.write("token", "an-entirely-new-secret");
    let flags = with(&with(&ACTOR, "--tls-certificate", "new-actor.pem"), "--tls-key", "new-actor.key");
    scene.actor(&url, &flags).expect(0);
    let log = learner.wait().stderr;
    for what in ["the TLS certificate", "the token file"] {
        assert!(log.contains(&format!("{what} has changed, and was read again")), "{log}");
    }
}

#[test]
fn nobody_is_let_in_by_accident() {
    let (scene, _) = cluster();
    let open = ["--actors", "1", "--listen", "0.0.0.0:0"];
    let (tls, token) = (&LEARNER[6..10], &LEARNER[4..6]);
    for (i, some) in [&[][..], tls, token].into_iter().enumerate() {
        let outcome = scene.train(&format!("open-{i}"), &[&open[..], some].concat()).expect(1);
        assert!(outcome.stderr.contains("service.listen is `0.0.0.0:0`"), "{}", outcome.stderr);
        assert!(outcome.stderr.contains("`insecure`"), "{}", outcome.stderr);
    }
    scene.train("closed", &[&open[..], tls, token].concat()).expect(0);
    let log = scene.train("insecure", &[&open[..], &["--insecure"]].concat()).expect(0).stderr;
    assert!(log.contains("without TLS or without a token"), "{log}");
}

#[test]
fn files_that_are_not_what_they_should_be() {
    let (scene, _) = cluster();
    scene.write("short", "hunter2");
    scene.write("empty.pem", "");
    for (flag, file, told) in [
        ("--token-file", "missing", "missing cannot be read"),
        ("--token-file", "short", "short holds 7 bytes"),
        ("--tls-certificate", "empty.pem", "no certificate in empty.pem"),
        ("--tls-certificate", "missing.pem", "no certificate in missing.pem"),
        ("--tls-key", "learner.pem", "no private key in learner.pem"),
        ("--tls-key", "actor.key", "the certificate in learner.pem and the key in actor.key"),
        ("--tls-client-ca", "token", "no certificate in token"),
    ] {
        let outcome = scene.train(&format!("run{flag}{file}"), &with(&LEARNER, flag, file)).expect(1);
        assert!(outcome.stderr.contains(told) && !outcome.stderr.contains("hunter2"), "{told}: {}", outcome.stderr);
    }
    for lonely in [["--tls-key", "learner.key"], ["--tls-certificate", "learner.pem"], ["--tls-client-ca", "ca.pem"]] {
        let outcome = scene.train("lonely", &lonely).expect(2);
        assert!(outcome.stderr.contains("service.tls_"), "{}", outcome.stderr);
    }
    for (flag, file, told) in [
        ("--token-file", "short", "short holds 7 bytes"),
        ("--tls-ca", "missing.pem", "cannot read missing.pem"),
        ("--tls-key", "actor.pem", "actor.pem"),
    ] {
        let outcome = scene.actor("https://127.0.0.1:1", &with(&ACTOR, flag, file)).expect(1);
        assert!(outcome.stderr.contains(told), "{told}: {}", outcome.stderr);
    }
}

#[test]
fn the_clusters_script_makes_files_that_work() {
    let scene = Scene::new();
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/certificates.sh");
    let made = || {
        let output =
            Command::new(script).args(["certs", "localhost", "127.0.0.1"]).current_dir(scene.path(".")).output();
        let output = output.unwrap();
        let told = String::from_utf8_lossy(&output.stderr).into_owned();
        (output.status.code(), String::from_utf8(output.stdout).unwrap(), told)
    };
    let (code, said, told) = made();
    if told.contains("missing: openssl") {
        eprintln!("skipped: openssl is not installed");
        return;
    }
    assert_eq!((code, said.lines().count()), (Some(0), 4), "{said}{told}");
    assert_eq!(made(), (Some(0), String::new(), String::new()), "what is there stays");
    for secret in ["ca.key", "learner.key", "actor.key", "token"] {
        let mode = std::fs::metadata(scene.path("certs").join(secret)).unwrap().permissions().mode();
        assert_eq!(mode & 0o077, 0, "{secret} is for its owner alone");
    }
    let rename = |flags: &[&str]| -> Vec<String> {
        let is_file =
            |flag: &str| flag == "token" || Path::new(flag).extension().is_some_and(|end| end == "pem" || end == "key");
        flags.iter().map(|flag| if is_file(flag) { format!("certs/{flag}") } else { (*flag).to_owned() }).collect()
    };
    let (learner, actor) = (rename(&LEARNER), rename(&ACTOR));
    let mut learner = scene.train("run", &learner.iter().map(String::as_str).collect::<Vec<_>>());
    let url = learner.url().replace("127.0.0.1", "localhost");
    scene.actor(&url, &actor.iter().map(String::as_str).collect::<Vec<_>>()).expect(0);
    learner.expect(0);
}

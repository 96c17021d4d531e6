//! The command lines of deploy/kubernetes, run here as they stand: paths and ports are other ones, and the length of the
//! run; names of flags, files, secrets and metrics are not.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use popgym_tests::manifests::{Job, text};
use popgym_tests::{Process, Program, Scene, kustomize, net};
use rustix::process::Signal;
use serde_json::Value;

/// A run of some seconds, whose epochs take hundredths of one.
const SHORT: [&str; 7] = [
    "--env=RepeatPreviousEasy",
    "--steps=16000",
    "--stop-at-mmer=1",
    "--threads=1",
    "--batch-steps=512",
    "--minibatch-steps=256",
    "--checkpoint-epochs=2",
];

fn home() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy/kubernetes")
}

fn render(directory: &str) -> Vec<Value> {
    kustomize::render(&home().join(directory)).unwrap()
}

fn program(job: &Job) -> Program {
    let programs = [Program::Learner, Program::Actor];
    *programs.iter().find(|program| job.container["command"][0] == program.name()).expect("a program of ours")
}

fn output(program: Program, args: &[&str]) -> String {
    let output = program.command().args(args).output().unwrap();
    assert!(output.status.success(), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

#[test]
fn the_programs_have_every_flag() {
    let mut seen = 0;
    for objects in ["train", "gpu", "study"].map(render) {
        for job in Job::all(&objects) {
            let args = job.args();
            let commands = args.iter().take_while(|arg| !arg.starts_with(['-', '/']));
            let help: Vec<&str> = commands.copied().chain(["--help"]).collect();
            let help = output(program(&job), &help);
            let known: BTreeSet<&str> = help.split(|c: char| !c.is_ascii_alphanumeric() && c != '-').collect();
            for flag in args.iter().filter(|arg| arg.starts_with('-')) {
                let name = flag.split_once('=').map_or(*flag, |(name, _)| name);
                assert!(known.contains(name), "{}: no flag {name} in {help}", job.name);
                seen += 1;
            }
        }
    }
    assert!(seen > 30, "{seen}");
}

#[test]
fn a_study_has_an_index_for_every_trial() {
    let objects = render("study");
    let study = home().join("study/study.toml");
    let trials = output(Program::Learner, &["study", "list", study.to_str().unwrap(), "--json"]);
    let trials: Vec<Value> = serde_json::from_str(&trials).unwrap();
    assert_eq!(Job::named(&objects, "popgym-study").spec["completions"], trials.len());
}

/// What the manifests start, in a scene: what is mounted is there, under another path.
struct Cluster {
    scene: Scene,
    objects: Vec<Value>,
    ports: Vec<(String, String)>,
}

impl Cluster {
    /// None where there is no openssl to make certificates with.
    fn new() -> Option<Self> {
        let (scene, objects) = (Scene::new(), render("train"));
        let script = home().join("../certificates.sh");
        let made =
            Command::new(script).arg(scene.path("certs")).args(["popgym-learner", "localhost"]).output().unwrap();
        if !made.status.success() && String::from_utf8_lossy(&made.stderr).contains("missing: openssl") {
            return None;
        }
        assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
        let mut ports = Vec::new();
        for job in Job::all(&objects) {
            for (mounted_at, volume) in job.mounts() {
                let directory = format!("{}{mounted_at}", job.name);
                fs::create_dir_all(scene.path(&directory)).unwrap();
                let map = |object: &&Value| object["metadata"]["name"] == volume["configMap"]["name"];
                let map = objects.iter().filter(|object| object["kind"] == "ConfigMap").find(map);
                for (name, file) in map.and_then(|map| map["data"].as_object()).into_iter().flatten() {
                    scene.write(&format!("{directory}/{name}"), text(file));
                }
                for file in files_of(text(&volume["secret"]["secretName"])) {
                    fs::copy(scene.path("certs").join(&file), scene.path(&directory).join(&file)).unwrap();
                }
            }
            for name in ["grpc", "metrics"].iter().filter(|name| job.port(name).is_some()) {
                let port = net::free_address().rsplit_once(':').unwrap().1.to_owned();
                ports.push((format!("{}", job.port(name).unwrap()), port));
            }
        }
        Some(Self { scene, objects, ports })
    }

    /// The address at which a job's port is here.
    fn address(&self, job: &str, port: &str) -> String {
        let there = Job::named(&self.objects, job).port(port).unwrap().to_string();
        let (_, here) = self.ports.iter().find(|(number, _)| *number == there).unwrap();
        format!("127.0.0.1:{here}")
    }

    fn start(&self, name: &str, more: &[&str]) -> Process {
        let job = Job::named(&self.objects, name);
        let mounts = job.mounts();
        let here = |arg: &str| {
            let mut arg = arg.replace("0.0.0.0:", "127.0.0.1:").replace("//popgym-learner:", "//localhost:");
            for (number, port) in &self.ports {
                arg = arg.strip_suffix(&format!(":{number}")).map_or(arg.clone(), |start| format!("{start}:{port}"));
            }
            let mounted = mounts.iter().find(|(path, _)| arg.contains(&format!("={path}/")));
            mounted.map_or(arg.clone(), |(path, _)| {
                arg.replacen(path, self.scene.path(&format!("{name}{path}")).to_str().unwrap(), 1)
            })
        };
        let args: Vec<String> =
            job.args().into_iter().map(here).chain(more.iter().map(|&arg| arg.to_owned())).collect();
        let args: Vec<&str> = args.iter().map(String::as_str).collect();
        self.scene.start(program(&job), &args)
    }

    fn rows(&self) -> usize {
        let metrics = fs::read_to_string(self.scene.path("learner/runs/run/metrics.csv")).unwrap_or_default();
        metrics.lines().count().saturating_sub(1)
    }
}

/// The files that the README puts into a secret.
fn files_of(secret: &str) -> Vec<String> {
    let readme = fs::read_to_string(home().join("README.md")).unwrap().replace("\\\n", " ");
    let command = readme.lines().find_map(|line| line.split_once(&format!("create secret generic {secret} ")));
    let files = command.map_or("", |(_, files)| files).split_whitespace();
    files.filter_map(|word| word.strip_prefix("--from-file=certs/").map(str::to_owned)).collect()
}

/// Every `popgym_...` that the manifests and their README name.
fn named_metrics() -> BTreeSet<String> {
    let mut names = BTreeSet::new();
    let mut directories = vec![home()];
    while let Some(directory) = directories.pop() {
        for entry in fs::read_dir(directory).unwrap().map(Result::unwrap) {
            if entry.file_type().unwrap().is_dir() {
                directories.push(entry.path());
                continue;
            }
            let text = fs::read_to_string(entry.path()).unwrap();
            let words = text.split(|c: char| !c.is_ascii_alphanumeric() && c != '_');
            names.extend(words.filter(|word| word.starts_with("popgym_")).map(str::to_owned));
        }
    }
    names
}

/// Waits until both probes of a program succeed.
fn is_ready(program: &mut Process, address: &str) {
    for path in ["/healthz", "/readyz"] {
        let answer = || net::request(address, path).ok()?.starts_with("HTTP/1.1 200").then_some(());
        program.until(&format!("200 at {address}{path}"), |_| answer());
    }
}

#[test]
fn what_the_manifests_start_is_a_run_that_outlives_its_learner() {
    let Some(cluster) = Cluster::new() else {
        eprintln!("skipped: openssl is not installed");
        return;
    };
    let mut learner = cluster.start("learner", &SHORT);
    let metrics = cluster.address("learner", "metrics");
    is_ready(&mut learner, &metrics);
    let mut actor = cluster.start("actor", &[]);
    let actors_metrics = cluster.address("actor", "metrics");
    is_ready(&mut actor, &actors_metrics);
    learner.until("three epochs", |_| (cluster.rows() >= 3).then_some(()));
    let seen = net::get(&metrics, "/metrics", &[]) + &net::get(&actors_metrics, "/metrics", &[]);
    for name in named_metrics() {
        assert!(seen.contains(&name), "no metric {name}");
    }
    // Evicted: its job starts another, and the actor, which nobody has touched, goes on with it.
    learner.signal(Signal::TERM);
    learner.expect(143);
    assert!(actor.is_running());
    let before = cluster.rows();
    cluster.start("learner", &SHORT).expect(0);
    assert!(cluster.rows() > before, "{before}");
    actor.expect(0);
    // Once more, by a controller that had not seen the end.
    let again = cluster.start("learner", &SHORT).expect(0);
    assert!(again.stdout.contains("already complete"), "{}", again.stdout);
}

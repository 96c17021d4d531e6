//! The manifests of deploy/kubernetes: valid by the published schemas, of one piece, and such that the programs do what
//! they say. What a cluster makes of them is the business of `tests/kubernetes.sh` (`make kubernetes`).

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use popgym_tests::kustomize;
use popgym_tests::manifests::{Job, list, text};
use popgym_tests::schemas::Schemas;
use serde_json::{Value, json};

/// What can be applied with `kubectl apply -k`.
const DIRECTORIES: [&str; 5] = ["train", "gpu", "study", "monitoring", "files"];

fn home() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy/kubernetes")
}

fn render(directory: &str) -> Vec<Value> {
    kustomize::render(&home().join(directory)).unwrap()
}

/// What the README shows how to make of which directory.
const OWN: [(&str, &str); 2] = [("my-run", "train"), ("my-study", "study")];

/// A copy of deploy/kubernetes with that.
fn with_the_readmes_own() -> tempfile::TempDir {
    let copy = tempfile::tempdir().unwrap();
    let status = Command::new("cp").arg("-r").arg(home()).arg(copy.path()).status().unwrap();
    assert!(status.success());
    let readme = readme();
    for (file, rest) in readme.split("cat > deploy/").skip(1).filter_map(|text| text.split_once(" <<'END'\n")) {
        let (text, _) = rest.split_once("\nEND\n").unwrap();
        let path = copy.path().join(file);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, format!("{text}\n")).unwrap();
    }
    copy
}

fn readme() -> String {
    fs::read_to_string(home().join("README.md")).unwrap()
}

fn expect(problems: &mut Vec<String>, holds: bool, problem: impl Into<String>) {
    if !holds {
        problems.push(problem.into());
    }
}

/// What is wrong with who restarts and ends what.
fn lives(objects: &[Value]) -> Vec<String> {
    let mut wrong = Vec::new();
    for set in objects.iter().filter(|object| object["kind"] == "JobSet") {
        let spec = &set["spec"];
        let (learner, actor) = (Job::named(objects, "learner"), Job::named(objects, "actor"));
        let mut expect = |holds, problem: &str| expect(&mut wrong, holds, problem);
        let end = json!({ "operator": "All", "targetReplicatedJobs": ["learner"] });
        expect(spec["successPolicy"] == end, "the end of the set is not the learner's end");
        let rules = list(&spec["failurePolicy"]["rules"]);
        let restarts = spec["failurePolicy"]["maxRestarts"] != 0
            || rules.iter().any(|rule| text(&rule["action"]).starts_with("Restart"));
        expect(!restarts, "a failure restarts the set");
        expect(actor.spec["backoffLimitPerIndex"] == i32::MAX, "the actors' job can fail");
        let ends = ["podFailurePolicy", "activeDeadlineSeconds", "backoffLimit", "maxFailedIndexes"];
        expect(ends.iter().all(|end| actor.spec[end].is_null()), "the actors' job can fail");
        expect(actor.pod["restartPolicy"] == "Never", "the schedule of one actor's restarts is that of all");
        expect(actor.spec["completions"] == actor.spec["parallelism"], "the number of actors cannot change");
        let one = learner.spec["completions"] == 1 && learner.spec["parallelism"] == 1;
        expect(one && learner.spec["podReplacementPolicy"] == "Failed", "there can be two learners");
        let status = learner.flag("--sigterm-status").and_then(|status| status.parse().ok()).unwrap_or(0);
        expect(status != 0, "after SIGTERM an unfinished run counts as complete");
        expect(learner.on_failure(status, None) == "Ignore", "SIGTERM counts as the learner's failure");
        let grace: i64 = learner.flag("--grace").map_or(30, |grace| grace.parse().unwrap());
        let pod_grace = learner.pod["terminationGracePeriodSeconds"].as_i64().unwrap_or(30);
        expect(pod_grace >= grace + 15, "the learner is killed while it writes its checkpoint");
    }
    for job in Job::all(objects).iter().filter(|job| job.container["name"] == "learner") {
        let mut expect = |holds, problem: &str| expect(&mut wrong, holds, format!("{}: {problem}", job.name));
        expect(job.pod["restartPolicy"] == "Never", "it has no podFailurePolicy that counts");
        expect(job.on_failure(1, Some("DisruptionTarget")) == "Ignore", "an eviction counts as a failure");
        expect(job.on_failure(1, None) == "Count", "failures do not count");
        expect(job.on_failure(2, None) == "FailJob", "wrong usage is tried again");
        expect(job.args().contains(&"--continue") || job.args().starts_with(&["study", "run"]), "it does not resume");
    }
    for object in objects.iter().filter(|object| object["kind"] == "Job") {
        let job = Job::named(objects, text(&object["metadata"]["name"]));
        let mut expect = |holds, problem: &str| expect(&mut wrong, holds, problem);
        expect(job.on_failure(130, None) == "Ignore", "an interrupted trial counts as a failure");
        expect(job.spec["backoffLimitPerIndex"].as_i64() > Some(0), "a trial that fails ends the others");
        expect(job.spec["completionMode"] == "Indexed", "trials have no index");
        expect(job.flag("--index") == Some("$(JOB_COMPLETION_INDEX)"), "trials do not take their index");
        expect(job.pod["terminationGracePeriodSeconds"].as_i64() >= Some(60), "trials are killed while they save");
    }
    wrong
}

/// What is wrong with names and numbers that must agree.
fn agreement<'a>(objects: &'a [Value], of_users: &BTreeMap<String, BTreeSet<String>>) -> Vec<String> {
    let mut wrong = Vec::new();
    let jobs = Job::all(objects);
    let object = |kind: &str, name: &Value| {
        objects.iter().find(|object| object["kind"] == kind && object["metadata"]["name"] == *name)
    };
    for job in &jobs {
        let mut expect = |holds, problem: &str| expect(&mut wrong, holds, format!("{}: {problem}", job.name));
        for (flag, port) in [("--listen", "grpc"), ("--metrics-listen", "metrics")] {
            let given = job.flag(flag);
            let address = job.port(port).map(|port| format!("0.0.0.0:{port}"));
            expect(given == address.as_deref(), &format!("{flag} is {given:?}, the port `{port}` {address:?}"));
        }
        for (probe, path) in
            [("startupProbe", "/healthz"), ("livenessProbe", "/healthz"), ("readinessProbe", "/readyz")]
        {
            let get = &job.container[probe]["httpGet"];
            let right = *get == json!({ "path": path, "port": "metrics" }) && job.port("metrics").is_some();
            // A study is no service: its trials come and go.
            let served = job.flag("--metrics-listen").is_some() && !job.args().starts_with(&["study", "run"]);
            expect(right || !served, &format!("{probe} is not for {path}"));
        }
        let paths = job.args().into_iter().map(|arg| arg.split_once('=').map_or(arg, |(_, value)| value));
        let mut paths: Vec<&str> = paths.filter(|path| path.starts_with('/')).collect();
        for (mounted_at, volume) in job.mounts() {
            let below = |path: &'a str| path.strip_prefix(mounted_at).and_then(|path| path.strip_prefix('/'));
            let used: BTreeSet<&str> = paths.iter().filter_map(|path| below(path)).collect();
            paths.retain(|path| below(path).is_none());
            let claim = object("PersistentVolumeClaim", &volume["persistentVolumeClaim"]["claimName"]);
            let map = object("ConfigMap", &volume["configMap"]["name"]);
            let secret = of_users.get(text(&volume["secret"]["secretName"]));
            let is_what_is_used = match (claim, map, secret) {
                (Some(_), None, None) => true,
                (None, Some(map), None) => used.iter().all(|file| map["data"].get(file).is_some()),
                (None, None, Some(files)) => files.iter().map(String::as_str).eq(used),
                _ => false,
            };
            expect(is_what_is_used, &format!("what is at {mounted_at} is not what is used"));
        }
        let unused = list(&job.pod["volumes"]).len() > job.mounts().len();
        expect(!unused, "a volume is not mounted");
        expect(paths.is_empty(), &format!("no volume holds {paths:?}"));
    }
    for service in objects.iter().filter(|object| object["kind"] == "Service") {
        let mut expect = |holds, problem: &str| expect(&mut wrong, holds, problem);
        let port = &service["spec"]["ports"][0];
        let selected: Vec<&Job> = jobs.iter().filter(|job| job.is_selected(&service["spec"]["selector"])).collect();
        let right = selected.len() == 1 && selected[0].port(text(&port["targetPort"])).is_some();
        expect(right && selected[0].name == "learner", "the service is not the learner's");
        let url = format!("https://{}:{}", text(&service["metadata"]["name"]), port["port"]);
        expect(Job::named(objects, "actor").flag("--learner") == Some(&url), "actors do not go to the service");
    }
    for policy in objects.iter().filter(|object| object["kind"] == "NetworkPolicy").map(|policy| &policy["spec"]) {
        let selected: Vec<&Job> =
            jobs.iter().filter(|job| job.is_selected(&policy["podSelector"]["matchLabels"])).collect();
        expect(&mut wrong, selected.len() == 1, "a network policy is for no pod");
        let rules = list(&policy["ingress"]).iter().map(|rule| (rule, "from", true));
        for (rule, peers, inwards) in rules.chain(list(&policy["egress"]).iter().map(|rule| (rule, "to", false))) {
            let labels = list(&rule[peers]).iter().map(|peer| &peer["podSelector"]["matchLabels"]);
            let peers: Vec<&Job> =
                labels.flat_map(|labels| jobs.iter().filter(|job| job.is_selected(labels))).collect();
            let listening = if inwards { &selected } else { &peers };
            let named = list(&rule["ports"]).iter().filter_map(|port| port["port"].as_str());
            for port in named {
                let open = !listening.is_empty() && listening.iter().all(|job| job.port(port).is_some());
                expect(&mut wrong, open, format!("a network policy opens `{port}`, which nobody has"));
            }
        }
    }
    wrong
}

/// What is wrong with what containers may do and use.
fn containment(objects: &[Value]) -> Vec<String> {
    let mut wrong = Vec::new();
    for job in Job::all(objects) {
        let mut expect = |holds, problem: &str| expect(&mut wrong, holds, format!("{}: {problem}", job.name));
        let (name, tag) = text(&job.container["image"]).rsplit_once(':').unwrap_or_default();
        let version = tag.strip_suffix("-cuda").unwrap_or(tag);
        expect(version == env!("CARGO_PKG_VERSION"), &format!("the image's tag is `{tag}`"));
        let program = text(&job.container["command"][0]);
        let image = format!("popgym-{}", if program == "sleep" { "learner" } else { program });
        expect(name.rsplit('/').next() == Some(&image), "not the program's image");
        let pod = &job.pod["securityContext"];
        let user = pod["runAsNonRoot"] == true && pod["runAsUser"].as_i64() > Some(0);
        expect(user && pod["seccompProfile"]["type"] == "RuntimeDefault", "it may be root");
        let container = &job.container["securityContext"];
        let shut = container["allowPrivilegeEscalation"] == false && container["readOnlyRootFilesystem"] == true;
        expect(shut && container["capabilities"] == json!({ "drop": ["ALL"] }), "it may do more than it needs");
        expect(job.pod["automountServiceAccountToken"] == false, "it may talk to the cluster");
        expect(job.container["env"].is_null(), "what it needs is in files");
        let resources = &job.container["resources"];
        let given = |kind: &str| ["cpu", "memory"].iter().all(|of| resources[kind][of].is_string());
        expect(given("requests") && given("limits"), "it says not what it needs");
        if let Some(run) = objects.iter().find_map(|object| object["data"]["run.toml"].as_str())
            && job.name == "learner"
        {
            let threads = run.parse::<toml::Table>().unwrap().get("threads").map(ToString::to_string);
            expect(threads.as_deref() == resources["limits"]["cpu"].as_str(), "its threads are not its CPUs");
        }
    }
    wrong
}

/// The secrets that the README makes: their names, and the files in them.
fn secrets() -> BTreeMap<String, BTreeSet<String>> {
    let text = readme().replace("\\\n", " ");
    let commands = text.lines().filter_map(|line| line.split_once("create secret generic "));
    let secret = |(_, rest): (&str, &str)| {
        let mut words = rest.split_whitespace();
        let name = words.next().unwrap().to_owned();
        let files = words.filter_map(|word| word.strip_prefix("--from-file=certs/"));
        (name, files.map(str::to_owned).collect())
    };
    commands.map(secret).collect()
}

fn problems(objects: &[Value]) -> Vec<String> {
    let schemas = Schemas::new();
    let mut wrong: Vec<String> = objects.iter().flat_map(|object| schemas.problems(object)).collect();
    wrong.extend(lives(objects));
    wrong.extend(agreement(objects, &secrets()));
    wrong.extend(containment(objects));
    wrong
}

#[test]
fn all_manifests_are_valid_and_of_one_piece() {
    let none: [String; 0] = [];
    for directory in DIRECTORIES {
        let mut objects = render(directory);
        assert!(!objects.is_empty(), "{directory}");
        if directory == "files" {
            // Of a run.
            objects.extend(render("train"));
        }
        assert_eq!(problems(&objects), none, "{directory}");
    }
    let copy = with_the_readmes_own();
    for (own, directory) in OWN {
        let objects = kustomize::render(&copy.path().join("kubernetes").join(own)).unwrap();
        assert_eq!(problems(&objects), none, "{own}");
        assert_ne!(objects, render(directory), "{own}");
    }
    // The monitor sees the programs of a run, and trials.
    let (train, study, monitoring) = (render("train"), render("study"), render("monitoring"));
    let (selector, endpoints) = (&monitoring[0]["spec"]["selector"], &monitoring[0]["spec"]["podMetricsEndpoints"]);
    for job in Job::all(&train).into_iter().chain(Job::all(&study)) {
        assert!(job.is_selected(&selector["matchLabels"]), "{}", job.name);
        assert_eq!(selector["matchExpressions"][0]["key"], "app.kubernetes.io/component");
        assert!(list(&selector["matchExpressions"][0]["values"]).contains(&job.labels["app.kubernetes.io/component"]));
        assert!(job.port(text(&endpoints[0]["port"])).is_some(), "{}", job.name);
    }
}

#[test]
fn every_manifest_is_used() {
    let mut used = BTreeSet::new();
    for directory in DIRECTORIES {
        let file = home().join(directory).join("kustomization.yaml");
        let kustomization = &kustomize::documents(&file).unwrap()[0];
        let files = list(&kustomization["configMapGenerator"]).iter().flat_map(|map| list(&map["files"]));
        used.extend(
            list(&kustomization["resources"]).iter().chain(files).map(|file| format!("{directory}/{}", text(file))),
        );
        used.insert(format!("{directory}/kustomization.yaml"));
    }
    for directory in DIRECTORIES {
        for entry in fs::read_dir(home().join(directory)).unwrap() {
            let name = format!("{directory}/{}", entry.unwrap().file_name().display());
            assert!(used.contains(&name), "{name} is in no kustomization.yaml");
        }
    }
}

#[test]
fn kubectl_renders_the_same() {
    if Command::new("kubectl").args(["version", "--client"]).output().is_err() {
        eprintln!("skipped: kubectl is not installed");
        return;
    }
    let copy = with_the_readmes_own();
    let home = copy.path().join("kubernetes");
    for directory in DIRECTORIES.into_iter().chain(OWN.map(|(own, _)| own)) {
        let output = Command::new("kubectl").arg("kustomize").arg(home.join(directory)).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let file = copy.path().join("rendered.yaml");
        fs::write(&file, output.stdout).unwrap();
        let key = |object: Value| ((object["kind"].to_string(), object["metadata"]["name"].to_string()), object);
        let theirs: BTreeMap<_, _> = kustomize::documents(&file).unwrap().into_iter().map(key).collect();
        let ours: BTreeMap<_, _> = kustomize::render(&home.join(directory)).unwrap().into_iter().map(key).collect();
        assert_eq!(theirs, ours, "{directory}");
    }
}

/// Every place in `value`.
fn places(value: &Value, at: &str, found: &mut Vec<String>) {
    let mut below = |name: &str, value| {
        let place = format!("{at}/{}", name.replace('~', "~0").replace('/', "~1"));
        places(value, &place, found);
        found.push(place);
    };
    match value {
        Value::Object(fields) => fields.iter().for_each(|(name, value)| below(name, value)),
        Value::Array(values) => values.iter().enumerate().for_each(|(index, value)| below(&index.to_string(), value)),
        _ => {}
    }
}

#[test]
fn a_field_that_there_is_not_and_a_value_of_another_kind_are_refused_everywhere() {
    let schemas = Schemas::new();
    let mut refused = 0;
    for object in DIRECTORIES.iter().flat_map(|directory| render(directory)) {
        let mut found = vec![String::new()];
        places(&object, "", &mut found);
        for place in found {
            let mut changed = object.clone();
            let value = changed.pointer_mut(&place).unwrap();
            // No field takes a truth for an object, a text, a number or a list; nor a text in the place of a truth.
            *value = if value.is_boolean() { json!("maybe") } else { json!(true) };
            assert_ne!(schemas.problems(&changed), [""; 0], "{} {place}", object["kind"]);
            let mut changed = object.clone();
            if let Some(fields) = changed.pointer_mut(&place).and_then(Value::as_object_mut) {
                // Maps whose names are free have values of one kind, which is never this.
                fields.insert("noSuchField".to_owned(), json!({}));
                assert_ne!(schemas.problems(&changed), [""; 0], "{} {place}", object["kind"]);
                refused += 1;
            }
        }
        for name in ["apiVersion", "kind", "metadata"] {
            let mut changed = object.clone();
            changed.as_object_mut().unwrap().remove(name);
            assert_ne!(schemas.problems(&changed), [""; 0], "{} without {name}", object["kind"]);
        }
    }
    assert!(refused > 200, "{refused}");
    let secret =
        json!({ "apiVersion": "v1", "kind": "Secret", "metadata": { "name": "a" }, "stringData": { "b": "c" } });
    assert_ne!(schemas.problems(&secret), [""; 0]);
}

/// `objects` of a directory with one value changed, which the schemas allow.
fn changed(directory: &str, kind: &str, pointer: &str, value: &Value) -> Vec<Value> {
    let mut objects = render(directory);
    let object = objects.iter_mut().find(|object| object["kind"] == kind).unwrap();
    let (parent, name) = pointer.rsplit_once('/').unwrap();
    let name = name.replace("~1", "/");
    let parent = object.pointer_mut(parent).unwrap_or_else(|| panic!("{kind} has no {pointer}"));
    match (parent, name.as_str()) {
        (Value::Array(parent), "-") => parent.push(value.clone()),
        (Value::Array(parent), index) => parent[index.parse::<usize>().unwrap()] = value.clone(),
        (parent, name) if value.is_null() => {
            assert!(parent.as_object_mut().unwrap().remove(name).is_some(), "{pointer}");
        }
        (parent, name) => parent[name] = value.clone(),
    }
    objects
}

#[test]
fn whatever_would_break_a_run_is_seen() {
    const LEARNER: &str = "/spec/replicatedJobs/0/template/spec";
    const ACTOR: &str = "/spec/replicatedJobs/1/template/spec";
    let restart = json!({ "name": "again", "action": "RestartJobSet" });
    let gone = Value::Null;
    let set = [
        ("/spec/successPolicy/operator", json!("Any"), "not the learner's end"),
        ("/spec/successPolicy/targetReplicatedJobs/0", json!("actor"), "not the learner's end"),
        ("/spec/failurePolicy/rules/-", restart, "restarts the set"),
        ("/spec/failurePolicy/maxRestarts", json!(3), "restarts the set"),
    ];
    let learner = [
        ("completions", json!(2), "two learners"),
        ("podReplacementPolicy", json!("TerminatingOrFailed"), "two learners"),
        ("podFailurePolicy/rules/0/action", json!("Count"), "wrong usage is tried again"),
        ("podFailurePolicy/rules/1/onPodConditions/0/type", json!("Ready"), "an eviction counts"),
        ("podFailurePolicy/rules/2/onExitCodes/values/0", json!(137), "SIGTERM counts as the learner's failure"),
        ("podFailurePolicy/rules/2/onExitCodes/values/-", json!(1), "failures do not count"),
        ("template/spec/restartPolicy", json!("OnFailure"), "podFailurePolicy"),
        ("template/spec/terminationGracePeriodSeconds", json!(60), "while it writes its checkpoint"),
        ("template/spec/containers/0/args/3", json!("--grace=80"), "it does not resume"),
        ("template/spec/containers/0/args/12", json!("--grace=80"), "counts as complete"),
        ("template/spec/containers/0/args/5", json!("--listen=127.0.0.1:50051"), "--listen is"),
        ("template/spec/containers/0/args/2", json!("--out=/elsewhere/run"), "no volume holds"),
        ("template/spec/containers/0/args/7", json!("--token-file=/secrets/password"), "/secrets is not what is used"),
        ("template/spec/containers/0/ports/0/containerPort", json!(50052), "--listen is"),
        ("template/spec/containers/0/ports/1/name", json!("web"), "--metrics-listen is"),
        ("template/spec/containers/0/readinessProbe/httpGet/path", json!("/healthz"), "not for /readyz"),
        ("template/spec/containers/0/image", json!("popgym-learner:latest"), "tag is `latest`"),
        ("template/spec/containers/0/image", json!("popgym-learner"), "tag is ``"),
        ("template/spec/containers/0/image", json!("popgym-actor:0.1.0"), "not the program's image"),
        ("template/spec/containers/0/resources/limits/cpu", json!("8"), "threads are not its CPUs"),
        ("template/spec/containers/0/resources/requests", gone.clone(), "what it needs"),
        ("template/spec/containers/0/securityContext/readOnlyRootFilesystem", json!(false), "more than it needs"),
        ("template/spec/containers/0/env", json!([{ "name": "TOKEN", "value": "x" }]), "is in files"),
        ("template/spec/securityContext/runAsUser", json!(0), "may be root"),
        ("template/spec/automountServiceAccountToken", gone.clone(), "talk to the cluster"),
        ("template/spec/volumes/0/persistentVolumeClaim/claimName", json!("other"), "/runs is not what is used"),
        ("template/spec/volumes/1/configMap/name", json!("other"), "/etc/popgym is not what is used"),
        ("template/spec/volumes/2/secret/secretName", json!("popgym-actor"), "/secrets is not what is used"),
        ("template/metadata/labels/app.kubernetes.io~1component", json!("trainer"), "not the learner's"),
    ];
    let actor = [
        ("backoffLimitPerIndex", json!(6), "actors' job can fail"),
        ("backoffLimit", json!(6), "actors' job can fail"),
        ("activeDeadlineSeconds", json!(3600), "actors' job can fail"),
        ("template/spec/restartPolicy", json!("OnFailure"), "that of all"),
        ("completions", json!(8), "number of actors"),
        ("template/spec/containers/0/args/0", json!("--learner=https://learner:50051"), "do not go to the service"),
    ];
    let in_train = |kind: &'static str| move |(at, value, said)| ("train", kind, at, value, said);
    let below = |job: &'static str| move |(at, value, said)| (format!("{job}/{at}"), value, said);
    let of_set = set.map(|(at, value, said)| (at.to_owned(), value, said)).into_iter();
    let of_set = of_set.chain(learner.map(below(LEARNER))).chain(actor.map(below(ACTOR))).map(in_train("JobSet"));
    let others = [
        ("train", "Service", "/spec/ports/0/targetPort", json!("web"), "not the learner's"),
        ("train", "Service", "/spec/ports/0/port", json!(443), "do not go to the service"),
        ("train", "Service", "/metadata/name", json!("learner"), "do not go to the service"),
        ("train", "NetworkPolicy", "/spec/ingress/0/ports/0/port", json!("web"), "opens `web`"),
        ("train", "NetworkPolicy", "/spec/podSelector/matchLabels/a", json!("b"), "for no pod"),
        ("train", "PersistentVolumeClaim", "/metadata/name", json!("runs"), "/runs is not what is used"),
        ("train", "ConfigMap", "/data", json!({ "other.toml": "" }), "/etc/popgym is not what is used"),
        ("study", "Job", "/spec/podFailurePolicy/rules/2/onExitCodes/values/0", json!(143), "interrupted trial"),
        ("study", "Job", "/spec/backoffLimitPerIndex", Value::Null, "ends the others"),
        ("study", "Job", "/spec/completionMode", json!("NonIndexed"), "no index"),
        ("study", "Job", "/spec/template/spec/containers/0/args/4", json!("--index=0"), "take their index"),
        ("study", "Job", "/spec/template/spec/terminationGracePeriodSeconds", json!(30), "while they save"),
    ];
    let others = others.map(|(directory, kind, at, value, said)| (directory, kind, at.to_owned(), value, said));
    for (directory, kind, at, value, said) in of_set.chain(others) {
        let objects = changed(directory, kind, &at, &value);
        let schemas = Schemas::new();
        let invalid: Vec<String> = objects.iter().flat_map(|object| schemas.problems(object)).collect();
        assert_eq!(invalid, [""; 0], "{at}: the schemas see this one");
        let problems = problems(&objects);
        assert!(problems.iter().any(|problem| problem.contains(said)), "{kind} {at} {value}: {problems:?}");
    }
}

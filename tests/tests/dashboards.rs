//! The dashboards' queries and the rules, in a real Prometheus that scrapes a real run; and what promtool says of rules and
//! configuration. Where these programs are not installed, the test says so and is counted as ignored.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode, Stdio};
use std::time::{Duration, Instant};

use libtest_mimic::{Arguments, Trial};
use popgym_tests::monitoring::{dashboards, deploy, items, panels, queries, rule_files, rules, variables};
use popgym_tests::{DEADLINE, Process, Scene, kustomize, net};
use serde_json::{Value, json};

/// What Grafana puts in place of the variables, where everything is chosen.
const CHOSEN: [(&str, &str); 9] = [
    ("$__rate_interval", "30s"),
    ("$__range", "10m"),
    ("$actor_job", ".*"),
    ("$actor", ".*"),
    ("$job", ".*"),
    ("$instance", ".*"),
    ("$group", "instance"),
    ("$env", ".*"),
    ("$memory", ".*"),
];

fn chosen(query: &str) -> String {
    let replaced = CHOSEN.iter().fold(query.to_owned(), |query, (name, value)| query.replace(name, value));
    let replaced = replaced.replace("$preset", ".*");
    assert!(!replaced.contains('$'), "a variable is left in {replaced}");
    replaced
}

/// A Prometheus that reads the metrics of these jobs once a second.
struct Prometheus {
    address: String,
    process: Process,
}

impl Prometheus {
    /// With the configuration of `deploy`: rules and jobs are its own, addresses and intervals are not.
    fn start(scene: &Scene, targets: &[(&str, &[&str])]) -> Self {
        let file = deploy("prometheus/prometheus.yml");
        let mut config = kustomize::documents(&file).unwrap().remove(0);
        config["global"] = json!({ "scrape_interval": "1s", "scrape_timeout": "1s", "evaluation_interval": "1s" });
        for pattern in config["rule_files"].as_array_mut().unwrap() {
            *pattern = json!(file.parent().unwrap().join(pattern.as_str().unwrap()));
        }
        let jobs = config["scrape_configs"].as_array_mut().unwrap();
        assert_eq!(jobs.len(), targets.len());
        for job in jobs {
            let name = job["job_name"].as_str().unwrap();
            let (_, addresses) =
                targets.iter().find(|(target, _)| *target == name).unwrap_or_else(|| panic!("job {name}"));
            *job = json!({ "job_name": name, "static_configs": [{ "targets": addresses }] });
        }
        // JSON is YAML.
        scene.write("prometheus.yml", &config.to_string());
        let address = net::free_address();
        let mut command = Command::new("prometheus");
        command.args(["--config.file=prometheus.yml", "--storage.tsdb.path=storage", "--log.level=warn"]);
        command.arg(format!("--web.listen-address={address}")).current_dir(scene.path(".")).stdin(Stdio::null());
        let mut prometheus = Self { address, process: Process::start("prometheus", command) };
        let address = prometheus.address.clone();
        prometheus.process.until("Prometheus", |_| {
            let answer = net::request(&address, "/-/ready").ok()?;
            answer.starts_with("HTTP/1.1 200").then_some(())
        });
        prometheus
    }

    /// The data that Prometheus answers with.
    fn ask(&self, path: &str, name: &str, value: &str) -> Value {
        let path = if name.is_empty() { path.to_owned() } else { format!("{path}?{name}={}", encoded(value)) };
        let answer = net::request(&self.address, &path).expect("an answer");
        let (head, body) = answer.split_once("\r\n\r\n").expect("an HTTP answer");
        let whole =
            if head.to_lowercase().contains("transfer-encoding: chunked") { joined(body) } else { body.to_owned() };
        let mut answer: Value = serde_json::from_str(&whole).unwrap_or_else(|error| panic!("{error}: {whole}"));
        assert_eq!(answer["status"], "success", "{value}: {}", answer["error"]);
        assert!(answer["warnings"].is_null(), "{value}: {}", answer["warnings"]);
        answer["data"].take()
    }

    /// How many finite numbers a query returns.
    fn finite(&self, query: &str) -> usize {
        let data = self.ask("/api/v1/query", "query", query);
        let result = data["result"].as_array().unwrap_or_else(|| panic!("{query}: {data}"));
        let number = |sample: &&Value| {
            sample["value"][1].as_str().and_then(|text| text.parse().ok()).is_some_and(f64::is_finite)
        };
        result.iter().filter(number).count()
    }
}

/// A value in a URL.
fn encoded(value: &str) -> String {
    value.bytes().fold(String::new(), |mut url, byte| {
        if byte.is_ascii_alphanumeric() {
            url.push(byte as char);
        } else {
            write!(url, "%{byte:02X}").unwrap();
        }
        url
    })
}

/// A body that came in pieces, each behind its length.
fn joined(body: &str) -> String {
    let (mut whole, mut rest) = (String::new(), body);
    while let Some((length, more)) = rest.split_once("\r\n") {
        let length = usize::from_str_radix(length, 16).expect("a length");
        if length == 0 {
            break;
        }
        whole.push_str(&more[..length]);
        rest = more[length..].trim_start_matches("\r\n");
    }
    whole
}

fn every_query_returns_data() {
    let scene = Scene::new();
    let (at_learner, at_actor) = (net::free_address(), net::free_address());
    let listen = ["--actors", "0", "--listen", "127.0.0.1:0", "--metrics-listen", at_learner.as_str()];
    let mut learner = scene.train("run", &[&listen[..], &["--steps", "10000000"]].concat());
    let mut actor = scene.actor(&learner.url(), &["--metrics-listen", &at_actor]);
    // Another run, so that what is for each run is seen to be.
    let at_other = net::free_address();
    let mut other = scene.train("other", &["--memory", "mlp", "--metrics-listen", &at_other, "--steps", "10000000"]);
    let prometheus = Prometheus::start(&scene, &[("learner", &[&at_learner, &at_other]), ("actor", &[&at_actor])]);
    scene.reached(&mut learner, "run", 3);
    scene.reached(&mut other, "other", 3);

    // Queries by panel, each with the number of series that it is to return.
    let mut pending: BTreeMap<String, Vec<(String, usize)>> = BTreeMap::new();
    for (file, dashboard) in dashboards() {
        for panel in panels(&dashboard) {
            let title = format!("{file}, {}", panel["title"].as_str().unwrap());
            let each_run =
                |target: &Value| target["legendFormat"].as_str().is_some_and(|legend| legend.contains("{{seed}}"));
            let runs = items(panel, "targets").iter().map(|target| if each_run(target) { 2 } else { 1 });
            let twice = pending.insert(title.clone(), queries(panel).map(chosen).zip(runs).collect());
            assert!(twice.is_none(), "two panels are {title}");
        }
    }
    assert!(pending.len() > 60, "{} panels", pending.len());
    let rules = rules();
    for rule in rules.iter().filter(|rule| !rule["record"].is_null()) {
        pending.insert(rule["record"].to_string(), vec![(rule["expr"].as_str().unwrap().to_owned(), 2)]);
    }
    let deadline = Instant::now() + DEADLINE;
    while !pending.is_empty() {
        assert!(Instant::now() < deadline, "no data: {pending:#?}");
        std::thread::sleep(Duration::from_secs(1));
        pending.retain(|_, queries| {
            queries.retain(|(query, wanted)| prometheus.finite(query) < *wanted);
            !queries.is_empty()
        });
    }

    for rule in &rules {
        prometheus.ask("/api/v1/query", "query", rule["expr"].as_str().unwrap());
    }
    let loaded = prometheus.ask("/api/v1/rules", "", "");
    let groups = loaded["groups"].as_array().unwrap();
    let loaded: Vec<&Value> = groups.iter().flat_map(|group| group["rules"].as_array().unwrap()).collect();
    assert_eq!(loaded.len(), rules.len());
    for rule in loaded {
        assert_eq!(rule["health"], "ok", "{rule}");
        assert_ne!(rule["state"], "firing", "{rule}");
    }
    for (file, dashboard) in dashboards() {
        for (series, label) in variables(&dashboard) {
            let values = prometheus.ask(&format!("/api/v1/label/{label}/values"), "match[]", &chosen(series));
            assert!(values.as_array().is_some_and(|values| !values.is_empty()), "{file}: no {label} of {series}");
        }
    }
    assert!(learner.is_running() && actor.is_running() && other.is_running());
}

/// Also where a run is as short as this one, or Prometheus' last scrape long before its end.
fn the_end_of_a_run_is_seen() {
    let scene = Scene::new();
    let metrics = net::free_address();
    let prometheus = Prometheus::start(&scene, &[("learner", &[&metrics]), ("actor", &[])]);
    popgym_tests::until("a first scrape", || (prometheus.finite("up") == 1).then_some(()));
    scene.train("run", &["--metrics-listen", &metrics, "--steps", "40960"]).expect(0);
    popgym_tests::until("a run that is complete", || {
        (prometheus.finite("last_over_time(popgym_learner_complete[10m]) == 1") == 1).then_some(())
    });
    // Once it is seen to be gone: not even pending.
    popgym_tests::until("no learner", || (prometheus.finite("popgym_learner_complete") == 0).then_some(()));
    std::thread::sleep(Duration::from_secs(2));
    assert_eq!(prometheus.finite("ALERTS{alertname='PopgymLearnerDown'}"), 0);
}

/// Runs promtool on files.
fn promtool(arguments: &[&str], files: &[PathBuf]) {
    let output = Command::new("promtool").args(arguments).args(files).output().unwrap();
    let said = String::from_utf8_lossy(&output.stdout) + String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && said.contains("SUCCESS"), "promtool {arguments:?}: {said}");
}

fn promtool_accepts_rules_and_configuration() {
    promtool(&["check", "rules", "--lint=all", "--lint-fatal"], &rule_files());
    promtool(&["check", "config", "--lint=all", "--lint-fatal"], &[deploy("prometheus/prometheus.yml")]);
}

fn each_alert_fires_when_it_should_and_only_then() {
    let cases = Path::new(env!("CARGO_MANIFEST_DIR")).join("prometheus-alerts.yml");
    assert!(fs::read_to_string(&cases).is_ok_and(|text| text.contains("alert_rule_test")));
    promtool(&["test", "rules"], &[cases]);
}

fn main() -> ExitCode {
    let args = Arguments::from_args();
    let present =
        |program: &str| Command::new(program).arg("--version").output().is_ok_and(|output| output.status.success());
    let missing: Vec<&str> = ["prometheus", "promtool"].into_iter().filter(|program| !present(program)).collect();
    if !missing.is_empty() {
        eprintln!("skipped: {} is not installed", missing.join(" and "));
    }
    let test = |name: &str, program: &str, run: fn()| {
        let run = move || {
            run();
            Ok(())
        };
        Trial::test(name, run).with_ignored_flag(missing.contains(&program))
    };
    let tests = vec![
        test("every_query_returns_data", "prometheus", every_query_returns_data),
        test("the_end_of_a_run_is_seen", "prometheus", the_end_of_a_run_is_seen),
        test("promtool_accepts_rules_and_configuration", "promtool", promtool_accepts_rules_and_configuration),
        test(
            "each_alert_fires_when_it_should_and_only_then",
            "promtool",
            each_alert_fires_when_it_should_and_only_then,
        ),
    ];
    libtest_mimic::run(&args, tests).exit_code()
}

//! The list of metrics, the programs, the dashboards and the rules: what one has, the others know.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

use popgym_tests::monitoring::{
    dashboards, deploy, items, listed, names, panels, queries, quoted, rules, variables, words,
};
use popgym_tests::{Scene, net};
use serde_json::Value;

/// What stands in the sources of the programs, without their tests' own directories.
fn sources() -> String {
    fn read(directory: &Path, text: &mut String) {
        for entry in fs::read_dir(directory).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                read(&path, text);
            } else if path.extension().is_some_and(|extension| extension == "rs") {
                text.push_str(&fs::read_to_string(&path).unwrap());
            }
        }
    }
    let mut text = String::new();
    for program in ["learner/src", "actor/src", "proto/src"] {
        read(&Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(program), &mut text);
    }
    text
}

/// The names of metrics that the sources have between quotation marks, and nothing beside them.
fn in_sources(text: &str) -> BTreeSet<String> {
    let own = |part: &&str| {
        let rest = part.strip_prefix("popgym_learner_").or_else(|| part.strip_prefix("popgym_actor_"));
        rest.is_some_and(|rest| {
            !rest.is_empty() && rest.chars().all(|letter| letter.is_ascii_lowercase() || letter == '_')
        })
    };
    text.split('"').filter(own).map(str::to_owned).collect()
}

/// What is served: each metric's type, and its labels with their values.
type Served = BTreeMap<String, (String, BTreeMap<String, BTreeSet<String>>)>;

fn served(text: &str) -> Served {
    let mut all = Served::new();
    for line in text.lines() {
        if let Some((name, kind)) = line.strip_prefix("# TYPE ").and_then(|rest| rest.split_once(' ')) {
            all.insert(name.to_owned(), (kind.to_owned(), BTreeMap::new()));
        } else if let Some((name, rest)) = line.split_once('{')
            && !line.starts_with('#')
        {
            let (labels, _) = rest.rsplit_once('}').unwrap();
            let name = name.strip_suffix("_bucket").unwrap_or(name);
            let (_, known) = all.get_mut(name).unwrap_or_else(|| panic!("no type before `{line}`"));
            let keys = labels.split(',').map(|label| label.split_once('=').unwrap().0);
            for (key, value) in keys.zip(quoted(labels, '"')) {
                known.entry(key.to_owned()).or_default().insert(value.to_owned());
            }
        }
    }
    all
}

#[test]
fn the_list_is_what_the_programs_serve() {
    let scene = Scene::new();
    let (at_learner, at_actor) = (net::free_address(), net::free_address());
    let listen = ["--actors", "0", "--listen", "127.0.0.1:0", "--metrics-listen", at_learner.as_str()];
    let mut learner = scene.train("run", &[&listen[..], &["--steps", "10000000"]].concat());
    let _actor = scene.actor(&learner.url(), &["--metrics-listen", &at_actor]);
    scene.reached(&mut learner, "run", 3);
    net::get(&at_learner, "/metrics", &["\npopgym_learner_return_mmer "]);
    net::get(&at_actor, "/metrics", &["\npopgym_actor_live_rows "]);
    let mut seen = Served::new();
    for address in [&at_learner, &at_actor] {
        // What a process says of itself, both do.
        seen.extend(served(&net::get(address, "/metrics", &["# TYPE process_start_time_seconds gauge\n"])));
    }

    let (listed, sources) = (listed(), sources());
    let process = seen.keys().filter(|name| name.starts_with("process_")).cloned();
    let programs: BTreeSet<String> = in_sources(&sources).into_iter().chain(process).collect();
    assert!(programs.len() > 60, "the sources have metrics: {programs:?}");
    assert_eq!(listed.keys().cloned().collect::<BTreeSet<_>>(), programs, "deploy/metrics.md, and the programs");
    for (name, listed) in &listed {
        let (kind, labels) = seen.get(name).unwrap_or_else(|| panic!("{name} is not served"));
        assert_eq!(kind, &listed.kind, "{name}");
        assert_eq!(labels.keys().collect::<Vec<_>>(), listed.labels.keys().collect::<Vec<_>>(), "{name}");
        // No values in the list: they are the run's own. All activities happen in a run of a few epochs with checkpoints.
        for (label, values) in labels {
            let listed = &listed.labels[label];
            assert!(listed.is_empty() || values == listed, "{name}: {label} is {values:?}");
        }
    }
}

/// The queries of all rules, each with the rule's name.
fn rule_queries() -> Vec<(String, String)> {
    let name = |rule: &Value| rule["record"].as_str().or(rule["alert"].as_str()).unwrap().to_owned();
    rules().iter().map(|rule| (name(rule), rule["expr"].as_str().unwrap().to_owned())).collect()
}

#[test]
fn what_is_asked_for_exists_and_what_exists_is_shown() {
    let listed = listed();
    let mut known: BTreeSet<String> = ["up".to_owned()].into();
    for (name, metric) in &listed {
        known.insert(name.clone());
        if metric.kind == "histogram" {
            known.extend(["_sum", "_count", "_bucket"].map(|suffix| format!("{name}{suffix}")));
        }
    }
    let recorded: BTreeSet<String> =
        rules().iter().filter_map(|rule| Some(rule["record"].as_str()?.to_owned())).collect();
    known.extend(recorded.clone());

    let (mut shown, mut asked) = (BTreeSet::new(), BTreeSet::new());
    let check = |place: &str, query: &str| {
        let names = names(query);
        assert!(!names.is_empty(), "{place} asks for nothing: {query}");
        for name in &names {
            assert!(known.contains(name), "{place} asks for {name}, which does not exist");
        }
        names
    };
    for (file, dashboard) in dashboards() {
        for panel in panels(&dashboard) {
            for query in queries(panel) {
                shown.extend(check(&format!("{file}, {}", panel["title"]), query));
            }
        }
        for (series, _) in variables(&dashboard) {
            asked.extend(check(&format!("{file}, a variable"), series));
        }
    }
    for (rule, query) in rule_queries() {
        let names = check(&rule, &query);
        if shown.contains(&rule) {
            shown.extend(names.clone());
        }
        asked.extend(names);
    }
    for name in listed.keys().filter(|name| name.starts_with("popgym_")) {
        // What is only there for its labels is shown by what it is joined to.
        let parts = shown.iter().any(|part| part.strip_prefix(name.as_str()) == Some("_bucket"));
        assert!(shown.contains(name) || parts, "no dashboard shows {name}");
    }
    for name in &recorded {
        assert!(shown.contains(name) || asked.contains(name), "nobody uses {name}");
    }
}

/// Reasons and activities that a query picks are those of the list.
#[test]
fn picked_values_exist() {
    let listed = listed();
    let from_dashboards = dashboards()
        .into_values()
        .flat_map(|dashboard| panels(&dashboard).flat_map(queries).map(str::to_owned).collect::<Vec<_>>());
    let mut picked = 0;
    for query in from_dashboards.chain(rule_queries().into_iter().map(|(_, query)| query)) {
        for label in ["reason", "activity"] {
            let possible: BTreeSet<&String> =
                listed.values().filter_map(|metric| metric.labels.get(label)).flatten().collect();
            for rest in query.split(&format!("{label}=")).skip(1) {
                for value in rest.trim_start_matches(['~', '"']).split('"').next().unwrap().split('|') {
                    assert!(possible.contains(&value.to_owned()), "{query}: no {label} is `{value}`");
                    picked += 1;
                }
            }
        }
    }
    assert!(picked > 5);
}

#[test]
fn each_alert_says_what_to_do() {
    let text = fs::read_to_string(deploy("metrics.md")).unwrap();
    let cases = fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("prometheus-alerts.yml")).unwrap();
    let headings: BTreeSet<&str> = text.lines().filter_map(|line| line.strip_prefix("### ")).collect();
    let rules = rules();
    let alerts: Vec<&Value> = rules.iter().filter(|rule| !rule["alert"].is_null()).collect();
    let mut named = BTreeSet::new();
    for alert in &alerts {
        let name = alert["alert"].as_str().unwrap();
        assert!(named.insert(name), "{name} is there twice");
        assert!(["critical", "warning"].contains(&alert["labels"]["severity"].as_str().unwrap()), "{name}");
        let summary = alert["annotations"]["summary"].as_str().unwrap();
        assert!(summary.contains("{{ $labels.instance }}") || summary.contains("{{ $labels.env }}"), "{name}");
        let action = alert["annotations"]["action"].as_str().unwrap();
        assert!(action.ends_with(&format!(": deploy/metrics.md#{}", name.to_lowercase())), "{name}: {action}");
        assert!(cases.contains(&format!("alertname=\"{name}\"")), "no test makes {name} fire");
    }
    assert_eq!(headings, named, "the headings of deploy/metrics.md, and the alerts");
    for word in words(&text).chain(words(&cases)).filter(|word| word.starts_with("Popgym")) {
        assert!(named.contains(word), "there is no alert {word}");
    }
    let listed = listed();
    for word in words(&text).filter(|word| word.starts_with("popgym_")) {
        assert!(listed.contains_key(word), "{word} is mentioned and not listed");
    }
}

#[test]
fn dashboards_are_of_one_piece() {
    let dashboards = dashboards();
    assert_eq!(dashboards.keys().collect::<Vec<_>>(), ["fleet", "study", "training"]);
    for (file, dashboard) in &dashboards {
        assert_eq!(dashboard["uid"], format!("popgym-{file}"));
        let (mut ids, mut cells) = (BTreeSet::new(), BTreeSet::new());
        for panel in items(dashboard, "panels") {
            let title = format!("{file}, {}", panel["title"]);
            assert!(ids.insert(panel["id"].as_u64().unwrap()), "{title}: its number is another's too");
            let [x, y, width, height] = ["x", "y", "w", "h"].map(|key| panel["gridPos"][key].as_u64().unwrap());
            assert!(x + width <= 24, "{title} is wider than the page");
            for cell in (x..x + width).flat_map(|x| (y..y + height).map(move |y| (x, y))) {
                assert!(cells.insert(cell), "{title} lies on another");
            }
        }
        let defined: BTreeSet<&str> =
            items(&dashboard["templating"], "list").iter().map(|variable| variable["name"].as_str().unwrap()).collect();
        for panel in panels(dashboard) {
            let title = format!("{file}, {}", panel["title"]);
            assert!(panel["description"].as_str().unwrap().ends_with('.'), "{title} is described");
            assert!(!panel["fieldConfig"]["defaults"]["unit"].as_str().unwrap().is_empty(), "{title} has a unit");
            assert_eq!(panel["datasource"]["uid"], "${datasource}", "{title}");
            assert!(queries(panel).count() > 0, "{title} asks for something");
            for query in queries(panel) {
                let ours = query.split('$').skip(1).map(|rest| words(rest).next().unwrap());
                for variable in ours.filter(|variable| !variable.starts_with("__")) {
                    assert!(defined.contains(variable), "{title}: ${variable} is not defined");
                }
            }
        }
        let text = dashboard.to_string();
        for variable in defined {
            assert!(text.contains(&format!("${variable}")) || text.contains(&format!("${{{variable}}}")), "{variable}");
        }
    }
}

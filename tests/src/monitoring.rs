//! What `deploy` has for Prometheus and Grafana: dashboards, rules, and the list of metrics.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::kustomize;

/// A path below `deploy`.
pub fn deploy(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy").join(path)
}

/// The dashboards, by the names of their files.
///
/// # Panics
/// If one is no JSON.
pub fn dashboards() -> BTreeMap<String, Value> {
    files("grafana/dashboards", "json")
        .into_iter()
        .map(|path| {
            let text = fs::read_to_string(&path).expect("a dashboard");
            let value = serde_json::from_str(&text).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
            (path.file_stem().expect("a name").to_string_lossy().into_owned(), value)
        })
        .collect()
}

/// The items of a list in JSON, none where there is no list.
pub fn items<'a>(value: &'a Value, name: &str) -> &'a [Value] {
    value[name].as_array().map_or(&[], Vec::as_slice)
}

/// A dashboard's panels, but for those that are only headings.
pub fn panels(dashboard: &Value) -> impl Iterator<Item = &Value> {
    items(dashboard, "panels").iter().filter(|panel| panel["type"] != "row")
}

/// A panel's queries, as they stand.
pub fn queries(panel: &Value) -> impl Iterator<Item = &str> {
    items(panel, "targets").iter().map(|target| target["expr"].as_str().expect("a query"))
}

/// What fills a dashboard's variables: the series it looks at, and the label whose values they take.
pub fn variables(dashboard: &Value) -> impl Iterator<Item = (&str, &str)> {
    let asked =
        items(&dashboard["templating"], "list").iter().filter_map(|variable| variable["query"]["query"].as_str());
    asked.map(|query| {
        let inner = query.strip_prefix("label_values(").and_then(|rest| rest.strip_suffix(')'));
        inner.and_then(|inner| inner.rsplit_once(", ")).unwrap_or_else(|| panic!("a variable asks `{query}`"))
    })
}

/// The files of rules.
pub fn rule_files() -> Vec<PathBuf> {
    files("prometheus/rules", "yml")
}

/// All rules.
///
/// # Panics
/// If a file is no YAML.
pub fn rules() -> Vec<Value> {
    let documents = rule_files().into_iter().flat_map(|path| kustomize::documents(&path).expect("YAML"));
    let groups: Vec<Value> = documents.flat_map(|document| items(&document, "groups").to_vec()).collect();
    groups.iter().flat_map(|group| items(group, "rules").to_vec()).collect()
}

/// The files with this extension in a directory of `deploy`, in order.
fn files(directory: &str, extension: &str) -> Vec<PathBuf> {
    let entries = fs::read_dir(deploy(directory)).expect("a directory");
    let paths = entries.map(|entry| entry.expect("an entry").path());
    let mut paths: Vec<PathBuf> = paths.filter(|path| path.extension().is_some_and(|own| own == extension)).collect();
    assert!(!paths.is_empty(), "no {extension} in {directory}");
    paths.sort();
    paths
}

/// A row of `deploy/metrics.md`.
#[derive(Debug)]
pub struct Listed {
    /// `gauge`, `counter` or `histogram`.
    pub kind: String,
    /// The labels' names, each with its values, where the list has them.
    pub labels: BTreeMap<String, BTreeSet<String>>,
}

/// The metrics in `deploy/metrics.md`.
///
/// # Panics
/// If it cannot be read, or one is there twice.
pub fn listed() -> BTreeMap<String, Listed> {
    let mut all = BTreeMap::new();
    for line in fs::read_to_string(deploy("metrics.md")).expect("the list").lines() {
        let cells: Vec<&str> = line.split('|').map(str::trim).collect();
        let Some(name) = cells.get(1).and_then(|cell| cell.strip_prefix('`')?.strip_suffix('`')) else { continue };
        assert_eq!(cells.len(), 8, "{name} has six columns");
        assert!(!cells[5].is_empty(), "{name} means something");
        // `label`, or `label`: `value`, `value` (explained), ...
        let mut labels: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
        let (named, values) = cells[4].split_once(": ").unwrap_or((cells[4], ""));
        let values: BTreeSet<String> = quoted(values, '`').map(str::to_owned).collect();
        for label in quoted(named, '`') {
            labels.insert(label.to_owned(), values.clone());
        }
        let twice = all.insert(name.to_owned(), Listed { kind: cells[2].to_owned(), labels });
        assert!(twice.is_none(), "{name} is listed twice");
    }
    all
}

/// What stands between pairs of a quotation mark.
pub fn quoted(text: &str, mark: char) -> impl Iterator<Item = &str> {
    text.split(mark).skip(1).step_by(2)
}

/// The words of a text that can be names of metrics.
pub fn words(text: &str) -> impl Iterator<Item = &str> {
    text.split(|letter: char| !(letter.is_ascii_alphanumeric() || letter == '_' || letter == ':'))
}

/// The metrics that a query asks for: our own, those of the process, recorded ones, and Prometheus' own.
pub fn names(query: &str) -> BTreeSet<String> {
    // Neither labels' values nor ranges.
    let outside: String = query.split('"').step_by(2).flat_map(|part| part.split('[').map(after_range)).collect();
    let named = words(&outside).filter(|word| {
        word.starts_with("popgym_")
            || word.starts_with("process_")
            || word.contains(':')
            || ["up", "ALERTS"].contains(word)
    });
    named.map(str::to_owned).collect()
}

/// What comes after a range, whose opening bracket is cut off already.
fn after_range(part: &str) -> &str {
    part.split_once(']').map_or(part, |(_, rest)| rest)
}

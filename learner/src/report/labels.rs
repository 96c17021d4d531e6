//! What tells runs apart: the configuration's keys that differ.

use std::collections::{BTreeMap, BTreeSet};

use toml::{Table, Value};

/// Keys that change how a run is carried out or kept, but not what comes out of it. `threads` is none of them: sums are
/// rounded differently with it, and the run takes another course.
const INDIFFERENT: [&str; 3] = ["service.", "checkpoint_epochs", "keep_checkpoints"];

/// The keys, such as `ppo.passes`, that not all of `configs` have the same value of.
pub fn differing_keys(configs: &[&Table]) -> Vec<String> {
    let flat: Vec<BTreeMap<String, &Value>> = configs.iter().map(|config| flat(config)).collect();
    let keys: BTreeSet<&String> = flat.iter().flat_map(BTreeMap::keys).collect();
    let differs = |key: &&&String| flat.iter().any(|values| values.get(**key) != flat[0].get(**key));
    let indifferent = |key: &str| INDIFFERENT.iter().any(|prefix| key.starts_with(prefix));
    keys.iter().filter(differs).filter(|key| !indifferent(key)).map(|key| (*key).clone()).collect()
}

/// A label of each of `configs`: the keys that differ, with their values. Those that differ in nothing have `names`.
pub fn labels(configs: &[&Table], names: &[String]) -> Vec<String> {
    let mut keys = differing_keys(configs);
    // A memory's name says more than its options, which differ with it.
    if keys.iter().any(|key| key == "memory.name") {
        keys.retain(|key| key == "memory.name" || !key.starts_with("memory."));
    }
    let value = |config: &Table, key: &String| flat(config).get(key).map_or_else(|| "unset".to_owned(), |v| bare(v));
    let label = |config: &&Table| -> String {
        let parts = keys.iter().map(|key| match key.as_str() {
            "memory.name" | "env" | "preset" => value(config, key),
            _ => format!("{} {}", key.rsplit('.').next().unwrap_or(key), value(config, key)),
        });
        parts.collect::<Vec<_>>().join(", ")
    };
    let labels: Vec<String> = configs.iter().map(label).collect();
    let unique = |label: &String| labels.iter().filter(|other| *other == label).count() == 1;
    // Where the configuration does not tell, the directory does.
    let complete = |(label, name): (&String, &String)| match label.as_str() {
        "" => name.clone(),
        _ if unique(label) => label.clone(),
        _ => format!("{label} ({name})"),
    };
    labels.iter().zip(names).map(complete).collect()
}

/// Text without quotes, ids without their wrapping, and small numbers as 1e-8.
pub(super) fn bare(value: &Value) -> String {
    match value {
        Value::String(text) => text.trim_start_matches("popgym-").trim_end_matches("-v0").to_owned(),
        Value::Float(number) => format!("{number:?}"),
        other => other.to_string(),
    }
}

/// All values that are no tables, by their dotted keys.
pub(super) fn flat(table: &Table) -> BTreeMap<String, &Value> {
    let mut values = BTreeMap::new();
    for (key, value) in table {
        match value {
            Value::Table(inner) => values.extend(flat(inner).into_iter().map(|(sub, v)| (format!("{key}.{sub}"), v))),
            other => {
                values.insert(key.clone(), other);
            }
        }
    }
    values
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tables(texts: &[&str]) -> Vec<Table> {
        texts.iter().map(|text| text.parse().unwrap()).collect()
    }

    fn labelled(texts: &[&str]) -> Vec<String> {
        let tables = tables(texts);
        let names: Vec<String> = (0..texts.len()).map(|i| format!("run{i}")).collect();
        labels(&tables.iter().collect::<Vec<_>>(), &names)
    }

    #[test]
    fn only_what_differs() {
        let found = labelled(&[
            "env = 'popgym-RepeatFirstEasy-v0'\nseed = 1\n[ppo]\nclip = 0.2\npasses = 3\n[service]\nactors = 1",
            "env = 'popgym-RepeatFirstEasy-v0'\nseed = 2\n[ppo]\nclip = 0.2\npasses = 4\n[service]\nactors = 2",
        ]);
        assert_eq!(found, ["passes 3, seed 1", "passes 4, seed 2"]);
    }

    #[test]
    fn numbers_are_short() {
        let found = labelled(&["x = 0.00000001", "x = 0.3", "x = 10.0", "x = inf", "x = 3"]);
        assert_eq!(found, ["x 1e-8", "x 0.3", "x 10.0", "x inf", "x 3"]);
    }

    #[test]
    fn threads_count_but_not_how_often_is_saved() {
        let found = labelled(&["threads = 1\ncheckpoint_epochs = 5", "threads = 2\ncheckpoint_epochs = 6"]);
        assert_eq!(found, ["threads 1", "threads 2"]);
    }

    #[test]
    fn names_of_memories_and_environments() {
        let found = labelled(&[
            "env = 'popgym-AEasy-v0'\n[memory]\nname = 'gru'\nhidden_size = 256",
            "env = 'popgym-BEasy-v0'\n[memory]\nname = 'fart'\nkey_size = 15",
        ]);
        assert_eq!(found, ["AEasy, gru", "BEasy, fart"]);
    }

    #[test]
    fn the_directory_where_nothing_differs() {
        assert_eq!(labelled(&["seed = 1", "seed = 1"]), ["run0", "run1"]);
        assert_eq!(labelled(&["seed = 1", "seed = 1", "seed = 2"]), ["seed 1 (run0)", "seed 1 (run1)", "seed 2"]);
        assert_eq!(labelled(&["seed = 1\nx = 2", "seed = 1"]), ["x 2", "x unset"]);
    }
}

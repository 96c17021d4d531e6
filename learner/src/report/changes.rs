//! What tells a run from others of the same preset: the keys on which results depend, where they are not the preset's own.

use popgym_envs::{Entry, Registry};
use popgym_models::memory;
use toml::{Table, Value};

use super::labels::{bare, flat};
use crate::config::Config;

/// The keys, and tables of keys, in question. All others say who learns what, for how long, or where and how fast.
const DECISIVE: [&str; 5] = ["ppo.", "policy.", "memory.", "lag", "max_episode_steps"];

/// The decisive keys of `config` that differ from its preset's own values for this environment, with their values, such as
/// `clip 0.4`. Empty where the preset is not known here: then nothing can be said.
pub fn changes(config: &Table, entry: &Entry, envs: &Registry, memories: &memory::Registry) -> Vec<String> {
    let text = |key: &str| config.get(key).and_then(Value::as_str).unwrap_or_default();
    let Some(own) = own(&entry.spec.id, text("preset"), memory_name(config), envs, memories) else {
        return Vec::new();
    };
    let own_values = flat(&own);
    let of_known_memory = |key: &str| !key.starts_with("memory.") || own.contains_key("memory");
    let decisive = |key: &str| DECISIVE.iter().any(|part| key == *part || part.ends_with('.') && key.starts_with(part));
    let changed = |key: &str, value: &Value| match (own_values.get(key), key) {
        // What is longer than the environment's own episodes never cuts any.
        (Some(own), "max_episode_steps") => effective(own, entry) != effective(value, entry),
        (own, _) => own != Some(&value),
    };
    let found = flat(config).into_iter();
    found
        .filter(|(key, value)| decisive(key) && of_known_memory(key) && key != "memory.name" && changed(key, value))
        .map(|(key, value)| format!("{} {}", key.rsplit('.').next().unwrap_or(&key), bare(value)))
        .collect()
}

/// The number of steps after which episodes are cut, if that is before their own end.
pub fn cut_after(config: &Table, entry: &Entry) -> Option<i64> {
    let limit = config.get("max_episode_steps")?.as_integer()?;
    (limit < i64::from(entry.spec.max_steps)).then_some(limit)
}

fn effective(limit: &Value, entry: &Entry) -> Option<i64> {
    limit.as_integer().map(|limit| limit.min(i64::from(entry.spec.max_steps)))
}

fn memory_name(config: &Table) -> &str {
    config.get("memory").and_then(|memory| memory.get("name")).and_then(Value::as_str).unwrap_or_default()
}

/// The configuration of `preset` with nothing changed; without `memory` where that is not known here.
fn own(env: &str, preset: &str, memory: &str, envs: &Registry, memories: &memory::Registry) -> Option<Table> {
    let given = Table::from_iter([("env", env), ("preset", preset)].map(|(k, v)| (k.to_owned(), v.into())));
    let mut own = Table::try_from(Config::resolve(&given, &Table::new(), envs, memories).ok()?).ok()?;
    match memories.get(memory).and_then(|entry| entry.resolve(&Table::new())) {
        Ok(options) => own.insert("memory".to_owned(), Value::Table(options)),
        Err(_) => own.remove("memory"),
    };
    Some(own)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn found(text: &str) -> Vec<String> {
        let (envs, memories) = (Registry::standard(), memory::Registry::standard());
        let config: Table = text.parse().unwrap();
        changes(&config, envs.get("RepeatFirstEasy").unwrap(), &envs, &memories)
    }

    #[test]
    fn only_what_results_depend_on() {
        // The preset's own: clip 0.3, passes 3, hidden_size 256, lag 0; RepeatFirstEasy has 52 steps.
        let plain = "preset = 'quick'\nseed = 7\nsteps = 5\nthreads = 3\nmax_episode_steps = 900\nservice.actors = 9\n\
                     stop_at_mmer = 0.5\ncheckpoint_epochs = 2\nppo.clip = 0.3\nmemory.name = 'gru'\n";
        assert_eq!(found(plain), [""; 0]);
        let other = "preset = 'quick'\nlag = 1\nmax_episode_steps = 20\nppo.clip = 0.4\nppo.passes = 3\n\
                     memory.name = 'gru'\nmemory.hidden_size = 128\n";
        assert_eq!(found(other), ["lag 1", "max_episode_steps 20", "hidden_size 128", "clip 0.4"]);
        let paper = "preset = 'paper'\nppo.clip = 0.3\nmemory.name = 'gru'\n";
        assert_eq!(found(paper), [""; 0]);
    }

    #[test]
    fn the_own_configuration_of_every_preset_and_memory_has_no_changes() {
        let (envs, memories) = (Registry::standard(), memory::Registry::standard());
        for (preset, _) in crate::config::PRESETS {
            for memory in memories.entries() {
                let given = format!("env = 'AutoencodeHard'\npreset = '{preset}'\nmemory.name = '{}'", memory.name);
                let config = Config::resolve(&given.parse().unwrap(), &Table::new(), &envs, &memories).unwrap();
                // As it is read from a file.
                let config: Table = config.to_toml().unwrap().parse().unwrap();
                let entry = envs.get("AutoencodeHard").unwrap();
                assert_eq!(changes(&config, entry, &envs, &memories), [""; 0], "{preset} {}", memory.name);
            }
        }
    }

    #[test]
    fn what_is_not_known_here() {
        assert_eq!(found("preset = 'own'\nppo.clip = 0.9\nmemory.name = 'gru'"), [""; 0]);
        assert_eq!(found("preset = 'quick'\nppo.clip = 0.9\nmemory.name = 'own'\nmemory.x = 1"), ["clip 0.9"]);
    }

    #[test]
    fn episodes_cut_short() {
        let envs = Registry::standard();
        let entry = envs.get("RepeatFirstEasy").unwrap();
        let longest = i64::from(entry.spec.max_steps);
        let cut = |limit: i64| cut_after(&Table::from_iter([("max_episode_steps".to_owned(), limit.into())]), entry);
        assert_eq!([longest - 1, longest, 1024].map(cut), [Some(longest - 1), None, None]);
    }
}

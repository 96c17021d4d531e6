//! Configurations.

use popgym_learner::config::{Config, Purpose};
use toml::Table;

use crate::toml_text::{quick_text, with_extensions};

/// Whether the text is a configuration.
pub fn configuration(data: &[u8]) -> bool {
    let Some((_, given)) = quick_text(data) else { return false };
    let Ok(config) = resolve(&given).map_err(|error| format!("{error:#}")) else { return false };
    let text = config.to_toml().expect("a configuration can be written");
    let written = text.parse().expect("what was written is TOML");
    let again = resolve(&written).expect("what was written is a configuration");
    assert_eq!(again, config);
    assert_eq!(config.difference(&again), None);
    let spec = config.run_spec("run", Purpose::Training).expect("a run can be told");
    assert_eq!(spec.check(), Ok(()), "actors can be told");
    true
}

fn resolve(table: &Table) -> anyhow::Result<Config> {
    with_extensions(|extensions| Config::resolve(table, &Table::new(), &extensions.envs, &extensions.memories))
}

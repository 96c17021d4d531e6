//! `learner list`: what can be named.

use serde_json::json;

use super::{Outcome, say};
use crate::Extensions;
use crate::args::{ListArgs, Listed};
use crate::config::PRESETS;

/// Prints the names of environments, memories or presets, as lines or as JSON.
///
/// # Errors
/// None that can be caused from outside.
pub fn list(args: &ListArgs, extensions: &Extensions) -> Outcome {
    if args.json {
        say(&format!("{:#}", as_json(args.what, extensions)))?;
        return Ok(0);
    }
    match args.what {
        Listed::Envs => {
            for entry in &extensions.envs {
                say(&format!("{:<28} {:<11} {}", entry.name, entry.group, entry.id()))?;
            }
        }
        Listed::Memories => {
            for entry in extensions.memories.entries() {
                say(&format!("{:<12} {}", entry.name, entry.paper_name))?;
            }
        }
        Listed::Presets => {
            for (name, about) in PRESETS {
                say(&format!("{name:<12} {about}"))?;
            }
        }
    }
    Ok(0)
}

fn as_json(what: Listed, extensions: &Extensions) -> serde_json::Value {
    match what {
        Listed::Envs => extensions
            .envs
            .iter()
            .map(|entry| {
                json!({
                    "id": entry.id(),
                    "name": entry.name,
                    "aliases": entry.aliases,
                    "group": entry.group,
                    "max_steps": entry.spec.max_steps,
                })
            })
            .collect(),
        Listed::Memories => extensions
            .memories
            .entries()
            .iter()
            .map(|entry| {
                let options = entry.resolve(&toml::Table::new()).unwrap_or_default();
                json!({ "name": entry.name, "paper_name": entry.paper_name, "options": options })
            })
            .collect(),
        Listed::Presets => PRESETS.iter().map(|(name, about)| json!({ "name": name, "about": about })).collect(),
    }
}

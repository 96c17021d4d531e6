//! `learner list`: what can be named.

use std::io::{IsTerminal as _, stdout};
use std::time::Duration;

use popgym_envs::{Entry, Registry};
use popgym_models::memory;
use serde_json::{Value, json};

use super::{Outcome, say};
use crate::Extensions;
use crate::args::{ListArgs, Listed};
use crate::baseline::Baseline;
use crate::config::PRESETS;
use crate::space_text::space_text;

/// How long the measurement of one environment's random agent may take.
const BASELINE_BUDGET: Duration = Duration::from_secs(1);

/// Prints the names of environments, memories or presets, as lines or as JSON.
///
/// # Errors
/// None that can be caused from outside.
pub fn list(args: &ListArgs, extensions: &Extensions) -> Outcome {
    let text = match args.what {
        Listed::Envs => envs(&extensions.envs, args.json)?,
        Listed::Memories => memories(&extensions.memories, args.json)?,
        Listed::Presets => presets(args.json),
    };
    say(text.trim_end())?;
    Ok(0)
}

fn envs(envs: &Registry, json: bool) -> anyhow::Result<String> {
    let baselines = baselines(envs)?;
    let both = envs.iter().zip(&baselines);
    Ok(if json { pretty(both.map(|(entry, baseline)| env_json(entry, baseline))) } else { table(both) })
}

fn memories(memories: &memory::Registry, json: bool) -> anyhow::Result<String> {
    let sized: Vec<(&memory::Entry, memory::Sizes)> = memories
        .entries()
        .iter()
        .map(|entry| Ok((entry, entry.sizes(popgym_models::policy::WIDTH, &toml::Table::new())?)))
        .collect::<anyhow::Result<_>>()?;
    if json {
        return Ok(pretty(sized.iter().map(|(entry, sizes)| {
            let options = entry.resolve(&toml::Table::new()).unwrap_or_default();
            json!({
                "name": entry.name,
                "paper_name": entry.paper_name,
                "paper": entry.paper,
                "state": sizes.state,
                "parameters": sizes.parameters,
                "options": options,
            })
        })));
    }
    let mut rows = vec![["NAME", "IN POPGYM", "STATE", "PARAMETERS", "PAPER"].map(str::to_owned)];
    rows.extend(sized.iter().map(|(entry, sizes)| {
        [entry.name, entry.paper_name, &sizes.state.to_string(), &sizes.parameters.to_string(), entry.paper]
            .map(str::to_owned)
    }));
    Ok(aligned(&rows, room()))
}

fn presets(json: bool) -> String {
    if json {
        pretty(PRESETS.iter().map(|(name, about)| json!({ "name": name, "about": about })))
    } else {
        lines(PRESETS)
    }
}

/// Names, and what each is, a line each.
fn lines<'a>(entries: impl IntoIterator<Item = (&'a str, &'a str)>) -> String {
    let lines: Vec<String> = entries.into_iter().map(|(name, about)| format!("{name:<12} {about}")).collect();
    lines.join("\n")
}

fn pretty(values: impl Iterator<Item = Value>) -> String {
    format!("{:#}", Value::Array(values.collect()))
}

/// What acting at random scores in each environment, measured on all cores.
fn baselines(envs: &Registry) -> anyhow::Result<Vec<Baseline>> {
    let entries: Vec<&Entry> = envs.iter().collect();
    let cores = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
    let share = entries.len().div_ceil(cores).max(1);
    let measure = |entries: &[&Entry]| -> Result<Vec<Baseline>, _> {
        entries.iter().map(|entry| Baseline::measure(envs, entry.id(), BASELINE_BUDGET)).collect()
    };
    std::thread::scope(|scope| {
        let workers: Vec<_> = entries.chunks(share).map(|chunk| scope.spawn(move || measure(chunk))).collect();
        let mut baselines = Vec::new();
        for worker in workers {
            // A panic of an environment is passed on.
            baselines.extend(worker.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))?);
        }
        Ok(baselines)
    })
}

/// An aligned line an environment under a header; more lines where a terminal is too narrow for one.
fn table<'a>(envs: impl Iterator<Item = (&'a Entry, &'a Baseline)>) -> String {
    let mut rows = vec![HEADER.map(str::to_owned)];
    rows.extend(envs.map(|(entry, baseline)| row(entry, baseline)));
    aligned(&rows, room())
}

/// Columns of the terminal; without one there is room for all.
fn room() -> usize {
    if stdout().is_terminal() { crate::screen::terminal::Terminal::size().columns } else { usize::MAX }
}

const COLUMNS: usize = 8;

const HEADER: [&str; COLUMNS] =
    ["ID", "GROUP", "STEPS", "RETURN", "RANDOM AGENT", "PAPER'S NAME", "OBSERVATION", "ACTION"];

/// Blanks between columns.
const GAP: usize = 2;
/// Blanks before the second line of a row, and further ones.
const INDENT: usize = 4;

fn row(entry: &Entry, baseline: &Baseline) -> [String; COLUMNS] {
    let spec = &entry.spec;
    let (low, high) = spec.return_range;
    [
        entry.id().to_owned(),
        entry.group.clone(),
        spec.max_steps.to_string(),
        format!("{} to {}", short(low), short(high)),
        baseline.to_string(),
        entry.paper_name.clone().unwrap_or_else(|| "-".to_owned()),
        space_text(&spec.observation),
        space_text(&spec.action),
    ]
}

/// At most three places.
fn short(x: f64) -> String {
    let text = format!("{x:.3}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

/// The rows with columns as wide as their widest cell. Where `room` columns are not enough for one line a row, each row has
/// as many as it needs.
fn aligned<const N: usize>(rows: &[[String; N]], room: usize) -> String {
    let widths: [usize; N] = std::array::from_fn(|i| rows.iter().map(|row| row[i].len()).max().unwrap_or(0));
    // Where each line begins.
    let (mut starts, mut length) = (vec![0], widths[0]);
    for (i, width) in widths.into_iter().enumerate().skip(1) {
        length += GAP + width;
        if length > room {
            starts.push(i);
            length = INDENT + width;
        }
    }
    let mut text = String::new();
    for row in rows {
        for (i, &start) in starts.iter().enumerate() {
            let end = starts.get(i + 1).copied().unwrap_or(N);
            let cells = (start..end).map(|column| format!("{:<1$}", row[column], widths[column]));
            let indent = " ".repeat(if i == 0 { 0 } else { INDENT });
            text += format!("{indent}{}", cells.collect::<Vec<_>>().join(&" ".repeat(GAP))).trim_end();
            text.push('\n');
        }
    }
    text
}

fn env_json(entry: &Entry, baseline: &Baseline) -> Value {
    let spec = &entry.spec;
    json!({
        "id": entry.id(),
        "name": entry.name,
        "aliases": entry.aliases,
        "paper_name": entry.paper_name,
        "group": entry.group,
        "difficulty": entry.difficulty,
        "observation": space_text(&spec.observation),
        "action": space_text(&spec.action),
        "state": space_text(&spec.state),
        "max_steps": spec.max_steps,
        "return_range": [spec.return_range.0, spec.return_range.1],
        "random": baseline,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_line_where_there_is_room_and_more_where_not() {
        let rows = [HEADER, ["an-id", "g", "1", "-1 to 1", "0.1 +- 0.2", "Paper", "Discrete(4)", "Box(1)"]];
        let rows = rows.map(|row| row.map(str::to_owned));
        let wide = aligned(&rows, usize::MAX);
        let lines: Vec<&str> = wide.lines().collect();
        assert_eq!(lines.len(), 2);
        for (title, cell) in HEADER.iter().zip(&rows[1]) {
            assert_eq!(
                lines[0].find(title),
                lines[1].find(&format!("  {cell}")).map(|at| at + 2).or(Some(0)),
                "{title}"
            );
        }
        let width = lines.iter().map(|line| line.len()).max().unwrap();
        assert_eq!(aligned(&rows, width), wide);
        let narrow = aligned(&rows, width - 1);
        assert_eq!(narrow.lines().count(), 4);
        assert!(narrow.lines().all(|line| line.len() < width));
        assert_eq!(narrow.lines().nth(3), Some("    Box(1)"), "only the last column has no room");
        // However narrow: a column is never torn.
        assert_eq!(aligned(&rows, 0).lines().count(), 2 * COLUMNS);
    }

    #[test]
    fn short_numbers() {
        assert_eq!([-1.0, 1.0, -1.230_77, 0.0, 200.0].map(short), ["-1", "1", "-1.231", "0", "200"]);
    }
}

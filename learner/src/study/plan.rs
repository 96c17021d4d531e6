//! What a study is made of: the study file, expanded to trials.

use std::collections::BTreeSet;
use std::path::Path;

use anyhow::{Context as _, bail, ensure};
use popgym_envs::{Difficulty, Entry};
use serde::Deserialize;
use toml::{Table, Value};

use crate::Extensions;
use crate::config::{self, Config, nearest};

/// Every environment, or every memory.
const ALL: &str = "all";

/// Most combinations of a study, those counted again that several products name: some ten times the whole benchmark with
/// every memory. A trial's number has four digits.
pub const MAX_TRIALS: usize = 10_000;

/// A study file, as it is written.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    /// Keys of every trial's configuration.
    #[serde(default)]
    run: Table,
    #[serde(default, rename = "product")]
    products: Vec<Product>,
    #[serde(default, rename = "override")]
    overrides: Vec<Override>,
}

/// All combinations of these.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Product {
    envs: Vec<String>,
    memories: Vec<String>,
    seeds: Vec<u64>,
}

/// Keys for some trials, over those of `[run]` and of overrides before.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Override {
    envs: Option<Vec<String>>,
    memories: Option<Vec<String>>,
    run: Table,
}

/// One run of a study.
#[derive(Clone, Debug, PartialEq)]
pub struct Trial {
    /// Its number, from 0.
    pub number: usize,
    /// The name of its directory, for example `0003-RepeatFirstEasy-gru-seed0`.
    pub name: String,
    /// Short name of the environment.
    pub env: String,
    /// Its whole configuration.
    pub config: Config,
}

/// The text of the study file `path` and its trials, in the order of its products, and within one of its environments, memories and
/// seeds as they are listed. A trial that several products name is there once.
///
/// Trials have one thread, one actor and no GPU unless the file says otherwise: a study's parallelism is between its trials, and
/// one that was begun on one machine goes on on another.
///
/// # Errors
/// The file cannot be read; or what in it is unknown, empty or impossible.
pub fn read(path: &Path, extensions: &Extensions) -> anyhow::Result<(String, Vec<Trial>)> {
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    let trials = parse(&text, extensions).with_context(|| path.display().to_string())?;
    Ok((text, trials))
}

/// The trials of a study file's text: as [`read`].
///
/// # Errors
/// As [`read`].
pub fn parse(text: &str, extensions: &Extensions) -> anyhow::Result<Vec<Trial>> {
    let plan = Plan::parse(text, extensions)?;
    (0..plan.combinations.len()).map(|number| plan.trial(number)).collect()
}

/// A study whose combinations are known and whose configurations are not resolved yet.
pub struct Plan<'a> {
    extensions: &'a Extensions,
    run: Table,
    selections: Vec<Selection>,
    combinations: Vec<Combination<'a>>,
}

/// What makes a trial itself.
struct Combination<'a> {
    env: &'a Entry,
    memory: String,
    seed: u64,
}

impl<'a> Plan<'a> {
    /// What a study file's text means.
    ///
    /// # Errors
    /// What in it is unknown or empty; more than [`MAX_TRIALS`] combinations.
    pub fn parse(text: &str, extensions: &'a Extensions) -> anyhow::Result<Self> {
        let file: File = toml::from_str(text).map_err(|error| anyhow::anyhow!(config::one_line(&error)))?;
        check_run(&file.run).context("[run]")?;
        ensure!(!file.products.is_empty(), "there is no [[product]] of environments, memories and seeds");
        let selections = selections(file.overrides, extensions)?;
        let (mut combinations, mut known, mut named) = (Vec::new(), BTreeSet::new(), 0_usize);
        for (product, number) in file.products.iter().zip(1..) {
            let of_product = || format!("[[product]] {number}");
            let envs = envs(&product.envs, extensions).with_context(of_product)?;
            let memories = memories(&product.memories, extensions).with_context(of_product)?;
            ensure!(!product.seeds.is_empty(), "{}: seeds is empty, allowed are one or more numbers", of_product());
            named = named.saturating_add(envs.len() * memories.len() * product.seeds.len());
            ensure!(
                named <= MAX_TRIALS,
                "{}: that makes {named} combinations, allowed are at most {MAX_TRIALS} in a study",
                of_product()
            );
            for env in envs {
                for memory in &memories {
                    for &seed in &product.seeds {
                        if known.insert((env.id().to_owned(), memory.clone(), seed)) {
                            combinations.push(Combination { env, memory: memory.clone(), seed });
                        }
                    }
                }
            }
        }
        Ok(Self { extensions, run: file.run, selections, combinations })
    }

    /// How many trials there are, at least one.
    #[expect(clippy::len_without_is_empty, reason = "it never is")]
    pub fn len(&self) -> usize {
        self.combinations.len()
    }

    /// The trial of this number, from 0.
    ///
    /// # Errors
    /// There is none; or what in its configuration is unknown or impossible.
    pub fn trial(&self, number: usize) -> anyhow::Result<Trial> {
        let this = self.combinations.get(number).with_context(|| format!("there is no trial {number}"))?;
        let config =
            Config::resolve(&self.given(this), &Table::new(), &self.extensions.envs, &self.extensions.memories);
        let config = config.with_context(|| format!("trial {number}, {}", this.env.name))?;
        let name = format!("{number:04}-{}-{}-seed{}", this.env.name, config.memory_name(), config.seed);
        Ok(Trial { number, name, env: this.env.name.clone(), config })
    }

    /// The keys of one trial's configuration.
    fn given(&self, this: &Combination<'_>) -> Table {
        let mut given = Table::from_iter([
            ("threads".to_owned(), Value::Integer(1)),
            ("device".to_owned(), Value::String("cpu".to_owned())),
            ("service".to_owned(), Value::Table(Table::from_iter([("actors".to_owned(), Value::Integer(1))]))),
        ]);
        config::merge(&mut given, &self.run);
        for selection in &self.selections {
            let has = |list: &Option<Vec<String>>, name: &str| {
                list.as_ref().is_none_or(|list| list.iter().any(|known| known == name))
            };
            if has(&selection.envs, this.env.id()) && has(&selection.memories, &this.memory) {
                config::merge(&mut given, &selection.run);
            }
        }
        let memory = Table::from_iter([("name".to_owned(), Value::String(this.memory.clone()))]);
        let itself = Table::from_iter([
            ("env".to_owned(), Value::String(this.env.id().to_owned())),
            ("seed".to_owned(), Value::Integer(this.seed as i64)),
            ("memory".to_owned(), Value::Table(memory)),
        ]);
        config::merge(&mut given, &itself);
        given
    }
}

/// The first difference that keeps a directory of the trials `old` from going on as one of `new`: trials may only be
/// added at the end.
pub fn difference(old: &[Trial], new: &[Trial]) -> Option<String> {
    if new.len() < old.len() {
        return Some(format!("it has {} trials there and {} here", old.len(), new.len()));
    }
    old.iter().zip(new).find_map(|(old, new)| {
        if old.name == new.name {
            let difference = new.config.difference(&old.config)?;
            Some(format!("in trial {}, {difference}", old.name))
        } else {
            Some(format!("trial {} is {} there and {} here", old.number, old.name, new.name))
        }
    })
}

/// What an override is for, resolved to environments' ids and memories' names; `None`: for all.
struct Selection {
    envs: Option<Vec<String>>,
    memories: Option<Vec<String>>,
    run: Table,
}

fn selections(overrides: Vec<Override>, extensions: &Extensions) -> anyhow::Result<Vec<Selection>> {
    let numbered = overrides.into_iter().zip(1..);
    numbered
        .map(|(this, number)| selection(this, extensions).with_context(|| format!("[[override]] {number}")))
        .collect()
}

fn selection(this: Override, extensions: &Extensions) -> anyhow::Result<Selection> {
    check_run(&this.run)?;
    let envs = this.envs.as_ref().map(|names| envs(names, extensions)).transpose()?;
    let envs = envs.map(|envs| envs.into_iter().map(|env| env.id().to_owned()).collect());
    let memories = this.memories.as_ref().map(|names| memories(names, extensions)).transpose()?;
    Ok(Selection { envs, memories, run: this.run })
}

/// What makes a trial itself is said by its product.
fn check_run(run: &Table) -> anyhow::Result<()> {
    for key in ["env", "seed"] {
        ensure!(!run.contains_key(key), "the key `{key}` belongs into a [[product]], as `{key}s`");
    }
    match run.get("memory") {
        Some(Value::Table(memory)) if memory.contains_key("name") => {
            bail!("the key `memory.name` belongs into a [[product]], as `memories`")
        }
        None | Some(Value::Table(_)) => Ok(()),
        Some(other) => bail!("memory is {other}, allowed is a table of options; names belong into a [[product]]"),
    }
}

/// The environments that `names` select, each once, in the order of the names: an id, a game (`RepeatFirst`: its
/// difficulties), a difficulty (`Easy`), a group (`control`), or `all` (those of the paper, or all where none is).
fn envs<'a>(names: &[String], extensions: &'a Extensions) -> anyhow::Result<Vec<&'a Entry>> {
    ensure!(!names.is_empty(), "envs is empty, allowed are ids, games, difficulties, groups, or `{ALL}`");
    let mut selected: Vec<&Entry> = Vec::new();
    for name in names {
        let of_name = select(name, extensions)?;
        selected.extend(
            of_name
                .into_iter()
                .filter(|entry| !selected.iter().any(|other| other.id() == entry.id()))
                .collect::<Vec<_>>(),
        );
    }
    Ok(selected)
}

fn select<'a>(name: &str, extensions: &'a Extensions) -> anyhow::Result<Vec<&'a Entry>> {
    let registry = &extensions.envs;
    let unknown = match registry.get(name) {
        Ok(entry) => return Ok(vec![entry]),
        Err(unknown) => unknown,
    };
    let those = |of: &dyn Fn(&Entry) -> bool| registry.iter().filter(|entry| of(entry)).collect::<Vec<_>>();
    if name == ALL {
        let in_paper = those(&|entry| entry.paper_name.is_some());
        return Ok(if in_paper.is_empty() { those(&|_| true) } else { in_paper });
    }
    let of_group = those(&|entry| entry.group == name);
    if !of_group.is_empty() {
        return Ok(of_group);
    }
    if let Some(difficulty) = Difficulty::ALL.into_iter().find(|difficulty| difficulty.to_string() == name) {
        return Ok(those(&|entry| entry.difficulty == Some(difficulty) && entry.paper_name.is_some()));
    }
    let levels: Vec<&Entry> =
        Difficulty::ALL.iter().filter_map(|level| registry.get(&format!("{name}{level}")).ok()).collect();
    if levels.is_empty() {
        let groups: BTreeSet<&str> = registry.iter().map(|entry| entry.group.as_str()).collect();
        let groups = groups.into_iter().collect::<Vec<_>>().join(", ");
        bail!("{unknown}; a game, a difficulty, a group ({groups}) or `{ALL}` may be named, too");
    }
    Ok(levels)
}

/// The names of memories, each once; `all` is all of them.
fn memories(names: &[String], extensions: &Extensions) -> anyhow::Result<Vec<String>> {
    ensure!(!names.is_empty(), "memories is empty, allowed are names of memories, or `{ALL}`");
    let known = || extensions.memories.entries().iter().map(|entry| entry.name);
    let mut selected: Vec<String> = Vec::new();
    for name in names {
        let of_name: Vec<&str> =
            if name == ALL { known().collect() } else { known().filter(|known| known == name).collect() };
        if of_name.is_empty() {
            let nearest = nearest(name, known()).unwrap_or_default();
            bail!("unknown memory `{name}`; did you mean `{nearest}`? (`learner list memories` lists all)");
        }
        selected.extend(
            of_name
                .into_iter()
                .filter(|name| !selected.iter().any(|other| other == name))
                .map(str::to_owned)
                .collect::<Vec<_>>(),
        );
    }
    Ok(selected)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn trials(text: &str) -> Vec<Trial> {
        parse(text, &Extensions::default()).unwrap_or_else(|error| panic!("{error:#}"))
    }

    fn names(text: &str) -> Vec<String> {
        trials(text).into_iter().map(|trial| trial.name).collect()
    }

    fn product(envs: &str, memories: &str, seeds: &str) -> String {
        format!("[[product]]\nenvs = {envs}\nmemories = {memories}\nseeds = {seeds}\n")
    }

    #[test]
    fn trials_are_in_the_order_of_the_lists_and_there_once() {
        let text = product("['CountRecallHard', 'popgym-RepeatFirstEasy-v0']", "['gru', 'mlp']", "[7, 0]")
            + &product("['RepeatFirst']", "['mlp']", "[0]");
        let expected = [
            "0000-CountRecallHard-gru-seed7",
            "0001-CountRecallHard-gru-seed0",
            "0002-CountRecallHard-mlp-seed7",
            "0003-CountRecallHard-mlp-seed0",
            "0004-RepeatFirstEasy-gru-seed7",
            "0005-RepeatFirstEasy-gru-seed0",
            "0006-RepeatFirstEasy-mlp-seed7",
            "0007-RepeatFirstEasy-mlp-seed0",
            "0008-RepeatFirstMedium-mlp-seed0",
            "0009-RepeatFirstHard-mlp-seed0",
        ];
        assert_eq!(names(&text), expected);
    }

    #[test]
    fn environments_are_selected_by_id_game_difficulty_group_or_all() {
        let count = |envs: &str| trials(&product(envs, "['mlp']", "[0]")).len();
        // The benchmark of the paper: 15 games at three difficulties.
        assert_eq!(count("['all']"), 45);
        assert_eq!(count("['Easy']"), 15);
        assert_eq!(count("['StatelessCartPole']"), 3, "by the paper's name");
        assert_eq!(count("['navigation']"), 6);
        assert_eq!(count("['navigation', 'LabyrinthEscape', 'LabyrinthEscapeEasy']"), 6, "each once");
        assert_eq!(trials(&product("['MineSweeperEasy']", "['all']", "[0]")).len(), 13);
    }

    #[test]
    fn overrides_go_over_the_runs_keys_in_their_order() {
        let text = "[run]\nsteps = 1000\nstop_at_mmer = 0.9\n[run.ppo]\npasses = 2\n".to_owned()
            + &product("['RepeatFirstEasy', 'LabyrinthEscapeEasy']", "['mlp', 'lmu']", "[0]")
            + "[[override]]\nenvs = ['navigation']\nrun = { steps = 2000, ppo = { gamma = 0.5 } }\n"
            + "[[override]]\nmemories = ['lmu']\nrun = { steps = 3000, memory = { theta = 9.0 } }\n";
        let trials = trials(&text);
        assert_eq!(trials.iter().map(|trial| trial.config.steps).collect::<Vec<_>>(), [1000, 3000, 2000, 3000]);
        for trial in &trials {
            assert_eq!((trial.config.ppo.passes, trial.config.stop_at_mmer), (2, Some(0.9)));
            assert_eq!((trial.config.threads, trial.config.service.actors), (1, 1), "on any machine");
        }
        let theta = |trial: &Trial| trial.config.memory.get("theta").and_then(Value::as_float);
        assert_eq!(trials.iter().map(theta).collect::<Vec<_>>(), [None, Some(9.0), None, Some(9.0)]);
        assert!((trials[3].config.ppo.gamma - 0.5).abs() < 1e-12);
    }

    #[test]
    fn mistakes_are_told_by_place() {
        let good = product("['all']", "['mlp']", "[0]");
        for (text, parts) in [
            (String::new(), &["[[product]]"][..]),
            ("steps = 5".to_owned(), &["steps", "product"]),
            (product("[]", "['mlp']", "[0]"), &["[[product]] 1", "envs is empty"]),
            (product("['all']", "[]", "[0]"), &["[[product]] 1", "memories is empty"]),
            (product("['all']", "['mlp']", "[]"), &["[[product]] 1", "seeds is empty"]),
            (
                good.clone() + &product("['RepeetFirst']", "['mlp']", "[0]"),
                &["[[product]] 2", "RepeetFirst", "RepeatFirst", "navigation"],
            ),
            (product("['all']", "['grru']", "[0]"), &["[[product]] 1", "grru", "`gru`"]),
            (product("['all']", "['mlp']", "[-1]"), &["-1"]),
            (good.clone() + "[[override]]\nenvs = ['none']\nrun = {}", &["[[override]] 1", "none"]),
            (good.clone() + "[[override]]\nenv = ['all']\nrun = {}", &["env"]),
            ("[run]\nenv = 'RepeatFirstEasy'\n".to_owned() + &good, &["[run]", "`env`", "[[product]]"]),
            ("[run]\nmemory = { name = 'gru' }\n".to_owned() + &good, &["[run]", "`memory.name`"]),
            ("[run]\nmemory = 'gru'\n".to_owned() + &good, &["[run]", "memory is \"gru\"", "[[product]]"]),
            ("[run]\nstep = 5\n".to_owned() + &good, &["RepeatFirstEasy", "unknown key `step`", "`steps`"]),
            ("[run]\nsteps = 0\n".to_owned() + &good, &["trial 0", "steps is 0"]),
            (
                product("['RepeatFirstEasy']", "['mlp']", "[0]")
                    + &product("['all']", "['all']", &format!("{:?}", [0; 18])),
                &["[[product]] 2", "10531 combinations", "10000"],
            ),
        ] {
            let error = format!("{:#}", parse(&text, &Extensions::default()).expect_err(&text));
            for part in parts {
                assert!(error.contains(part), "`{part}` is not in: {error}");
            }
            assert!(!error.contains('\n'), "{error}");
        }
    }

    #[test]
    fn trials_may_be_added_at_the_end_only() {
        let old = trials(&product("['RepeatFirstEasy']", "['mlp', 'gru']", "[0]"));
        let more = trials(&product("['RepeatFirstEasy', 'RepeatFirstHard']", "['mlp', 'gru']", "[0]"));
        assert_eq!(difference(&old, &old), None);
        assert_eq!(difference(&old, &more), None);
        assert!(difference(&more, &old).unwrap().contains("4 trials there and 2 here"));
        let other = trials(&product("['RepeatFirstEasy']", "['mlp', 'lstm']", "[0]"));
        assert!(difference(&old, &other).unwrap().contains("0001-RepeatFirstEasy-gru-seed0"));
        let longer =
            trials(&("[run]\nsteps = 7\n".to_owned() + &product("['RepeatFirstEasy']", "['mlp', 'gru']", "[0]")));
        assert!(difference(&old, &longer).unwrap().contains("steps is 1000000 there and 7 here"));
        let actors =
            "[run]\nservice = { actors = 3 }\n".to_owned() + &product("['RepeatFirstEasy']", "['mlp', 'gru']", "[0]");
        assert_eq!(difference(&old, &trials(&actors)), None, "how it is carried out may change");
    }
}

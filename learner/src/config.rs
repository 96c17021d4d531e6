//! The configuration of a run: the only place where preset, file and flags are merged.
//!
//! All three are TOML tables of the same keys. The preset's table is complete, so a key that it lacks is unknown; the
//! file's table goes over it, and the flags' over both.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use popgym_envs::{EnvSpec, Observability};
use popgym_models::{Policy, PolicyOptions, PolicySpec, memory};
use popgym_proto::RunSpec;
use popgym_proto::transport::metrics_address;
use serde::{Deserialize, Serialize};
use tch::Device;
use toml::{Table, Value};

use crate::service::TlsFiles;

pub use crate::ppo_keys::{LearningRateSchedule, Ppo, PpoFlags};

/// The presets' names, with what each is for.
pub const PRESETS: [(&str, &str); 2] = [
    ("quick", "tuned for wall-clock time on a CPU with two cores (default)"),
    ("paper", "the hyper-parameters of the paper's code: 15M steps, epochs of 65,536 steps, 30 passes"),
];

/// A run's resolved configuration: `config.toml` of its directory.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Canonical id of the environment.
    pub env: String,
    /// How much of the environment the agent is shown: `partial` is the benchmark's task, `full` the hidden state.
    pub observability: Observability,
    /// The preset that the other keys' defaults come from.
    pub preset: String,
    /// Seed of everything random in the run.
    pub seed: u64,
    /// 0: an epoch is sampled with the weights of the last update; 1: with those before, while the learner learns.
    pub lag: u32,
    /// The run stops after the first epoch with as many environment steps.
    pub steps: u64,
    /// The run also stops after the first epoch whose MMER reaches this.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stop_at_mmer: Option<f64>,
    /// `cpu` or `cuda` (`auto` is resolved when the run starts).
    pub device: String,
    /// Threads of the learner's libtorch; part of what the results depend on.
    pub threads: u32,
    /// An episode that reaches as many steps is truncated.
    pub max_episode_steps: u32,
    /// Rows that an actor pads its batch to where, on its machine, a result depends on the number of rows.
    pub rows: u32,
    /// Epochs between checkpoints.
    pub checkpoint_epochs: u64,
    /// Checkpoints kept, beside the best.
    pub keep_checkpoints: u32,
    /// How the run is carried out; nothing here changes its results.
    pub service: ServiceConfig,
    /// Name and options of the memory.
    pub memory: Table,
    /// Options of the policy outside its memory.
    pub policy: PolicyOptions,
    /// Hyper-parameters.
    pub ppo: Ppo,
}

/// How a run is carried out: the configuration's `[service]` table.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ServiceConfig {
    /// Local actor processes; 0: wait for remote ones.
    pub actors: u32,
    /// Episodes that a local actor steps at a time.
    pub slots: u32,
    /// How a local actor is started: a program and its first arguments, `@self` for this program. Empty: the `actor`
    /// beside this program, or what a user's own program says.
    pub actor_command: Vec<String>,
    /// Address for actors; empty: any free port of this machine for local actors, port 50051 of this machine for others.
    pub listen: String,
    /// Address for Prometheus: a port, for this machine alone, or IP:PORT; empty: none.
    pub metrics_listen: String,
    /// File of the token that actors must show; empty: none.
    pub token_file: String,
    /// File of the learner's certificate (PEM); empty: no TLS.
    pub tls_certificate: String,
    /// File of its private key.
    pub tls_key: String,
    /// File of the CA that signs actors' certificates; empty: they need none.
    pub tls_client_ca: String,
    /// Listen beyond this machine even without TLS or a token.
    pub insecure: bool,
}

impl ServiceConfig {
    /// The learner's certificate, if it has one.
    pub fn tls(&self) -> Option<TlsFiles> {
        let file = |path: &str| (!path.is_empty()).then(|| PathBuf::from(path));
        let (certificate, key) = (file(&self.tls_certificate)?, PathBuf::from(&self.tls_key));
        Some(TlsFiles { certificate, key, client_ca: file(&self.tls_client_ca) })
    }

    /// The file of the token, if there is one.
    pub fn token(&self) -> Option<PathBuf> {
        (!self.token_file.is_empty()).then(|| PathBuf::from(&self.token_file))
    }

    fn validate_tls(&self) -> anyhow::Result<()> {
        if self.tls_certificate.is_empty() != self.tls_key.is_empty() {
            bail!(
                "service.tls_certificate is `{}` and service.tls_key is `{}`, allowed are both or neither",
                self.tls_certificate,
                self.tls_key
            );
        }
        if self.tls_certificate.is_empty() && !self.tls_client_ca.is_empty() {
            bail!("service.tls_client_ca is `{}`, allowed only with service.tls_certificate", self.tls_client_ca);
        }
        Ok(())
    }
}

/// What episodes are played for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Purpose {
    /// To learn from them.
    Training,
    /// To see how good the policy is: on streams of their own, never those of training.
    Evaluation {
        /// The likeliest actions are taken, none is drawn.
        greedy: bool,
    },
}

/// More local actors than this are a slip of the pen.
const MAX_LOCAL_ACTORS: u64 = 256;

/// Keys of the `[service]` table: what may change when a run is resumed.
const SERVICE: &str = "service";

impl Config {
    /// Merges preset, `file` and `flags`; checks and resolves everything.
    ///
    /// # Errors
    /// The key that is unknown (with the nearest right one) or has a wrong type, or the value that is impossible.
    pub fn resolve(
        file: &Table,
        flags: &Table,
        envs: &popgym_envs::Registry,
        memories: &memory::Registry,
    ) -> anyhow::Result<Self> {
        let mut given = file.clone();
        merge(&mut given, flags);
        let preset = text(&given, "preset", "")?.unwrap_or("quick");
        let env = text(&given, "env", "")?.unwrap_or("popgym-RepeatPreviousEasy-v0");
        let entry = envs.get(env)?;
        let mut table = preset_table(preset, &entry.spec)?;
        check_keys(&given, &table, "")?;
        merge(&mut table, &given);
        table.insert("env".to_owned(), Value::String(entry.spec.id.clone()));
        resolve_memory(&mut table, memories)?;
        let config: Self = table.try_into().map_err(|error: toml::de::Error| anyhow::anyhow!(one_line(&error)))?;
        config.validate()?;
        // Builds and drops a policy: memory and spaces check their own options.
        let observed = entry.observed(config.observability)?;
        Policy::new(&config.policy_spec(&observed), memories, Device::Cpu)?;
        Ok(config)
    }

    /// Reads the resolved configuration of a run directory.
    ///
    /// # Errors
    /// The file cannot be read, or is not a configuration.
    pub fn load(
        path: &Path,
        flags: &Table,
        envs: &popgym_envs::Registry,
        memories: &memory::Registry,
    ) -> anyhow::Result<Self> {
        let file = read_table(path)?;
        Self::resolve(&file, flags, envs, memories).with_context(|| path.display().to_string())
    }

    /// The configuration as TOML.
    ///
    /// # Errors
    /// None that a valid configuration can cause.
    pub fn to_toml(&self) -> anyhow::Result<String> {
        Ok(toml::to_string(self)?)
    }

    /// The first key that makes this another run than `other`, with both values; the `[service]` table does not count.
    pub fn difference(&self, other: &Self) -> Option<String> {
        let mut tables = [Table::try_from(self).ok()?, Table::try_from(other).ok()?];
        for table in &mut tables {
            table.remove(SERVICE);
        }
        difference(&tables[0], &tables[1], "")
    }

    /// Why a run with so many steps and such an MMER is complete, if it is.
    pub fn reached(&self, env_steps: u64, mmer: Option<f64>) -> Option<&'static str> {
        let target = self.stop_at_mmer.unwrap_or(f64::INFINITY);
        if mmer.is_some_and(|mmer| mmer >= target) {
            Some("mmer")
        } else {
            (env_steps >= self.steps).then_some("steps")
        }
    }

    /// Name of the memory.
    pub fn memory_name(&self) -> &str {
        self.memory.get("name").and_then(Value::as_str).unwrap_or_default()
    }

    /// The memory's options.
    pub fn memory_options(&self) -> Table {
        let mut options = self.memory.clone();
        options.remove("name");
        options
    }

    /// What the policy is built from.
    pub fn policy_spec(&self, env: &EnvSpec) -> PolicySpec {
        PolicySpec {
            observation: env.observation.clone(),
            action: env.action.clone(),
            memory: self.memory_name().to_owned(),
            memory_options: self.memory_options(),
            options: self.policy,
            max_steps: env.max_steps,
        }
    }

    /// What actors are told.
    ///
    /// # Errors
    /// None that a valid configuration can cause.
    pub fn run_spec(&self, run: &str, purpose: Purpose) -> anyhow::Result<RunSpec> {
        Ok(RunSpec {
            run: run.to_owned(),
            env: self.env.clone(),
            observability: self.observability,
            max_episode_steps: self.max_episode_steps,
            memory: self.memory_name().to_owned(),
            memory_options: self.memory_options(),
            policy_options: Table::try_from(self.policy)?,
            seed: self.seed,
            lag: self.lag,
            rows: self.rows,
            evaluation: purpose != Purpose::Training,
            greedy: purpose == Purpose::Evaluation { greedy: true },
        })
    }

    /// Checks every value that stands alone.
    ///
    /// # Errors
    /// The first key that is impossible, its value, and what is allowed.
    pub fn validate(&self) -> anyhow::Result<()> {
        let range = |key: &str, value: u64, least: u64, most: u64| {
            if (least..=most).contains(&value) {
                Ok(())
            } else {
                Err(anyhow::anyhow!("{key} is {value}, allowed is {least} to {most}"))
            }
        };
        // TOML's integers end there.
        range("seed", self.seed, 0, i64::MAX as u64)?;
        range("lag", u64::from(self.lag), 0, 1)?;
        range("steps", self.steps, 1, 1 << 50)?;
        range("threads", u64::from(self.threads), 1, 1024)?;
        range(
            "max_episode_steps",
            u64::from(self.max_episode_steps),
            1,
            u64::from(popgym_proto::limits::MAX_EPISODE_STEPS),
        )?;
        range("rows", u64::from(self.rows), 16, u64::from(popgym_proto::limits::MAX_SLOTS))?;
        range("checkpoint_epochs", self.checkpoint_epochs, 1, 1 << 30)?;
        range("keep_checkpoints", u64::from(self.keep_checkpoints), 1, 1000)?;
        range("service.actors", u64::from(self.service.actors), 0, MAX_LOCAL_ACTORS)?;
        range("service.slots", u64::from(self.service.slots), 1, u64::from(popgym_proto::limits::MAX_SLOTS))?;
        let ServiceConfig { listen, metrics_listen, actor_command, .. } = &self.service;
        if actor_command.iter().any(|word| word.is_empty() || word.contains('\0')) {
            bail!("service.actor_command is {actor_command:?}, allowed is a program and arguments, none of them empty");
        }
        let is_address = |(host, port): (&str, &str)| !host.is_empty() && port.parse::<u16>().is_ok();
        if !listen.is_empty() && !listen.rsplit_once(':').is_some_and(is_address) {
            bail!("service.listen is `{listen}`, allowed is HOST:PORT");
        }
        if !metrics_listen.is_empty() {
            metrics_address(metrics_listen).map_err(|problem| anyhow::anyhow!("service.{problem}"))?;
        }
        self.service.validate_tls()?;
        if self.stop_at_mmer.is_some_and(f64::is_nan) {
            bail!("stop_at_mmer is NaN, allowed is a number");
        }
        if !["auto", "cpu", "cuda"].contains(&self.device.as_str()) {
            bail!("device is `{}`, allowed are auto, cpu, cuda", self.device);
        }
        self.ppo.validate().map_err(anyhow::Error::msg)
    }
}

/// Reads a TOML file.
///
/// # Errors
/// The file cannot be read, or is not TOML.
pub fn read_table(path: &Path) -> anyhow::Result<Table> {
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    text.parse().map_err(|error: toml::de::Error| anyhow::anyhow!("{}: {}", path.display(), one_line(&error)))
}

fn preset_table(name: &str, env: &EnvSpec) -> anyhow::Result<Table> {
    let (ppo, steps, log_std) = match name {
        "quick" => (Ppo::quick(env), 1_000_000, (-3.0, 2.0)),
        "paper" => (Ppo::paper(), 15_000_000, (f64::NEG_INFINITY, f64::INFINITY)),
        _ => {
            let nearest = nearest(name, PRESETS.iter().map(|(name, _)| *name)).unwrap_or_default();
            bail!("unknown preset `{name}`; did you mean `{nearest}`? (`learner list presets` lists all)");
        }
    };
    let cores = std::thread::available_parallelism().map_or(1, std::num::NonZero::get) as u32;
    let config = Config {
        env: env.id.clone(),
        observability: Observability::Partial,
        preset: name.to_owned(),
        seed: 0,
        lag: 0,
        steps,
        stop_at_mmer: None,
        device: "auto".to_owned(),
        // More threads than this only wait for one another in networks of this size.
        threads: cores.min(8),
        max_episode_steps: 1024,
        rows: 128,
        checkpoint_epochs: 10,
        keep_checkpoints: 3,
        service: ServiceConfig { actors: cores, slots: 128, ..ServiceConfig::default() },
        memory: Table::from_iter([("name".to_owned(), Value::String("gru".to_owned()))]),
        policy: PolicyOptions { log_std_min: log_std.0, log_std_max: log_std.1 },
        ppo,
    };
    Ok(Table::try_from(config)?)
}

/// Fills in the memory's defaults and refuses options that it does not have.
fn resolve_memory(table: &mut Table, memories: &memory::Registry) -> anyhow::Result<()> {
    let Some(Value::Table(memory)) = table.get_mut("memory") else {
        bail!("memory must be a table such as [memory] name = \"gru\"");
    };
    let name = text(memory, "name", "memory.")?.unwrap_or_default().to_owned();
    let mut options = memory.clone();
    options.remove("name");
    let entry = memories.get(&name)?;
    check_keys(&options, &entry.resolve(&Table::new())?, "memory.")?;
    *memory = entry.resolve(&options)?;
    memory.insert("name".to_owned(), Value::String(name));
    Ok(())
}

/// Puts the keys of `over` over those of `base`, table by table.
pub(crate) fn merge(base: &mut Table, over: &Table) {
    for (key, value) in over {
        match (base.get_mut(key), value) {
            (Some(Value::Table(base)), Value::Table(over)) => merge(base, over),
            _ => {
                base.insert(key.clone(), value.clone());
            }
        }
    }
}

/// Refuses keys of `given` that `known` lacks. Optional keys and the memory's options are known elsewhere.
fn check_keys(given: &Table, known: &Table, path: &str) -> anyhow::Result<()> {
    for (key, value) in given {
        match (known.get(key), value) {
            (Some(_), Value::Table(_)) if path.is_empty() && key == "memory" => {}
            (Some(Value::Table(known)), Value::Table(given)) => check_keys(given, known, &format!("{path}{key}."))?,
            (Some(Value::Table(_)), other) => bail!("{path}{key} is {other}, allowed is a table: [{key}]"),
            (Some(_), _) => {}
            (None, _) if path.is_empty() && key == "stop_at_mmer" => {}
            (None, _) => {
                let hint = nearest(key, known.keys().map(String::as_str))
                    .map_or_else(String::new, |nearest| format!("; did you mean `{path}{nearest}`?"));
                bail!("unknown key `{path}{key}`{hint}");
            }
        }
    }
    Ok(())
}

fn difference(a: &Table, b: &Table, path: &str) -> Option<String> {
    let keys: std::collections::BTreeSet<&String> = a.keys().chain(b.keys()).collect();
    keys.into_iter().find_map(|key| match (a.get(key), b.get(key)) {
        (Some(Value::Table(a)), Some(Value::Table(b))) => difference(a, b, &format!("{path}{key}.")),
        (a, b) if a == b => None,
        (a, b) => {
            let show = |value: Option<&Value>| value.map_or_else(|| "unset".to_owned(), Value::to_string);
            Some(format!("{path}{key} is {} there and {} here", show(b), show(a)))
        }
    })
}

/// The value of a key that must be text, if it is there.
fn text<'a>(table: &'a Table, key: &str, path: &str) -> anyhow::Result<Option<&'a str>> {
    match table.get(key) {
        None => Ok(None),
        Some(Value::String(text)) => Ok(Some(text)),
        Some(other) => bail!("{path}{key} is {other}, allowed is text"),
    }
}

/// The most similar of `names`.
pub fn nearest<'a>(name: &str, names: impl Iterator<Item = &'a str>) -> Option<&'a str> {
    let likeness = |known: &str| strsim::jaro_winkler(known, &name.to_lowercase());
    names.max_by(|a, b| likeness(a).total_cmp(&likeness(b)))
}

pub(crate) fn one_line(error: &toml::de::Error) -> String {
    error.to_string().split_whitespace().collect::<Vec<_>>().join(" ")
}

//! `learner export`: a trained agent as a file that other programs run.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use popgym_models::{Policy, export as policy_export};
use serde_json::json;
use tch::Device;

use super::{Failure, Outcome, choose_checkpoint, say};
use crate::Extensions;
use crate::args::ExportArgs;
use crate::config::Config;
use crate::files;
use crate::manifest;
use crate::run_dir::RunDir;

/// Writes the policy's step as TorchScript, with the weights of a checkpoint, and its description beside it.
///
/// # Errors
/// A directory without a run or without a checkpoint; files that cannot be written.
pub fn export(args: &ExportArgs, extensions: &Extensions) -> Outcome {
    let (path, description) = (&args.torchscript, beside(&args.torchscript));
    let check = || {
        anyhow::ensure!(RunDir::holds_run(&args.dir), "{} holds no run (no config.toml)", args.dir.display());
        files::check_writable(path)?;
        files::check_writable(&description)
    };
    check().map_err(Failure::Usage)?;
    let config = RunDir::config_path(&args.dir);
    let config = Config::load(&config, &toml::Table::new(), &extensions.envs, &extensions.memories);
    let config = config.map_err(Failure::Usage)?;
    let entry = extensions.envs.get(&config.env).map_err(anyhow::Error::from)?;
    let env = entry.observed(config.observability).map_err(anyhow::Error::from)?;
    let spec = config.policy_spec(&env);
    let policy = Policy::new(&spec, &extensions.memories, Device::Cpu).map_err(anyhow::Error::from)?;
    let parameters = policy.parameters().values().map(|tensor| tensor.numel() as i64).sum();
    let checkpoint = choose_checkpoint(&args.dir, args.checkpoint, parameters)?
        .ok_or_else(|| Failure::Usage(anyhow::anyhow!("{} holds no checkpoint yet", args.dir.display())))?;

    let module = policy_export::torchscript(&spec, &extensions.memories, &checkpoint.weights);
    let module = module.context("the policy cannot be exported")?;
    let mut about = manifest::describe(&config, &env, &policy);
    about["checkpoint_epoch"] = json!(checkpoint.progress.epoch);
    about["call"] = json!("parameters, value, *state = policy(observation, previous_action, first, *state)");
    files::replace(path, |partial| Ok(std::fs::write(partial, module)?))?;
    files::write(&description, &format!("{about:#}"))?;
    say(&format!("{}\n{}", path.display(), description.display()))?;
    Ok(0)
}

/// The path of the description beside `path`.
fn beside(path: &Path) -> PathBuf {
    let mut name = OsString::from(path);
    name.push(".json");
    PathBuf::from(name)
}

//! What a policy's files are, for people and other programs: in the manifest of each checkpoint and beside an exported
//! policy.

use popgym_envs::EnvSpec;
use popgym_models::Policy;
use serde_json::{Value, json};
use tch::Tensor;

use crate::config::Config;
use crate::space_text::space_text;

/// Environment, memory, spaces, and the shapes of weights and state (rows left out).
pub fn describe(config: &Config, env: &EnvSpec, policy: &Policy) -> Value {
    let shapes: serde_json::Map<String, Value> =
        policy.parameters().iter().map(|(name, tensor)| (name.clone(), json!(tensor.size()))).collect();
    let state: Vec<Vec<i64>> =
        policy.initial_state(1).0.iter().map(|tensor: &Tensor| tensor.size()[1..].to_vec()).collect();
    json!({
        "env": config.env,
        "memory": config.memory_name(),
        "memory_options": config.memory_options(),
        "preset": config.preset,
        "build": env!("CARGO_PKG_VERSION"),
        "observation": space_text(&env.observation),
        "action": space_text(&env.action),
        "action_parameters": policy.distribution().width(),
        "state": state,
        "weights": shapes,
    })
}

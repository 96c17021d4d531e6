//! Study files.

use popgym_learner::study::plan::{self, MAX_TRIALS, Plan};

use crate::toml_text::{quick_text, with_extensions};

/// Whether the text is a study whose first and last trial can be run.
pub fn study(data: &[u8]) -> bool {
    let Some((text, _)) = quick_text(data) else { return false };
    with_extensions(|extensions| {
        let Ok(plan) = Plan::parse(text, extensions).map_err(|error| format!("{error:#}")) else { return false };
        assert!((1..=MAX_TRIALS).contains(&plan.len()));
        assert!(plan.trial(plan.len()).is_err());
        let ends = [0, plan.len() - 1].map(|number| plan.trial(number).map_err(|error| format!("{error:#}")));
        let [Ok(first), Ok(last)] = ends else { return false };
        for (trial, number) in [(&first, 0), (&last, plan.len() - 1)] {
            assert_eq!(trial.number, number);
            assert!(trial.name.starts_with(&format!("{number:04}-{}-", trial.env)), "{}", trial.name);
            // It names a directory.
            assert!(trial.name.chars().all(|c| c.is_ascii_alphanumeric() || "-_".contains(c)), "{}", trial.name);
            assert!(extensions.envs.get(&trial.env).is_ok_and(|entry| entry.id() == trial.config.env));
        }
        assert_eq!(first == last, plan.len() == 1, "each trial is there once");
        assert_eq!(plan::difference(std::slice::from_ref(&first), &[first.clone(), last]), None);
        true
    })
}

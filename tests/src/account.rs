//! Checks a run's account, `events.jsonl`, from its first line to its last: no episode is used twice, none comes from another
//! version than its epoch's, each from the actor that held its lease, each batch is a prefix, and lag is what was configured.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use serde_json::Value;

use crate::Scene;

/// What an account tells, once it has been found in order.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Account {
    /// Times that a learner began to serve the run.
    pub starts: usize,
    /// Epochs whose batch is complete, and its steps; of one that was sampled again the last.
    pub epochs: BTreeMap<u64, u64>,
    /// Actors that came, each time that they did.
    pub joined: usize,
    /// Those of them that had been there before.
    pub returned: usize,
    /// Leases that were lost with their actors.
    pub lost_leases: u64,
    /// Episodes refused, by reason.
    pub refused: BTreeMap<String, u64>,
}

#[derive(Debug, Default)]
struct Open {
    epoch: u64,
    version: u64,
    target: Value,
    held: HashMap<u64, String>,
    accepted: BTreeSet<u64>,
}

#[derive(Debug, Default)]
struct Checker {
    account: Account,
    run: Option<String>,
    lag: u64,
    /// Epoch that was opened last by this learner.
    last: Option<u64>,
    open: Option<Open>,
    actors: BTreeSet<String>,
    finished: bool,
}

impl Account {
    /// Reads and checks the account of `run`, and holds it against `metrics.csv`.
    ///
    /// # Panics
    /// With the first line that breaks a rule.
    pub fn check(scene: &Scene, run: &str) -> Self {
        let text = scene.read(&format!("{run}/events.jsonl"));
        assert!(text.ends_with('\n'), "{run}: the account's last line is torn");
        let mut checker = Checker::default();
        for (number, line) in text.lines().enumerate() {
            let fact = serde_json::from_str(line).unwrap_or_else(|error| panic!("line {number}: {error}: {line}"));
            checker.read(&fact).unwrap_or_else(|problem| panic!("{run}, line {}: {problem}: {line}", number + 1));
        }
        let metrics = scene.metrics(run);
        let mut steps = 0;
        for (epoch, row) in metrics.lines().skip(1).enumerate() {
            let fields: Vec<u64> = row.split(',').take(2).map(|field| field.parse().expect("a number")).collect();
            steps += checker.account.epochs.get(&(epoch as u64)).copied().expect("a row has a batch");
            assert_eq!(fields, [epoch as u64, steps], "{run}: the account has other steps than metrics.csv");
        }
        checker.account
    }
}

impl Checker {
    fn read(&mut self, fact: &Value) -> Result<(), String> {
        let (event, actor) = (text(fact, "event")?, text(fact, "actor").unwrap_or_default());
        if self.finished && !["started", "left"].contains(&event) {
            return Err("the run was finished".to_owned());
        }
        match event {
            "started" => self.started(fact),
            "opened" => self.opened(fact),
            "joined" => self.joined(fact, actor),
            "left" => self.left(number(fact, "leases")?, actor),
            "leased" => self.leased(fact, actor),
            "accepted" => self.accepted(fact, actor),
            "refused" => self.refused(fact),
            "closed" => self.closed(fact),
            "finished" => {
                self.finished = true;
                Ok(())
            }
            other => Err(format!("no such event as {other}")),
        }
    }

    fn started(&mut self, fact: &Value) -> Result<(), String> {
        let run = text(fact, "run")?.to_owned();
        same("run", self.run.get_or_insert_with(|| run.clone()), &run)?;
        self.lag = number(fact, "lag")?;
        self.account.starts += 1;
        self.actors.clear();
        (self.open, self.last, self.finished) = (None, None, false);
        Ok(())
    }

    fn opened(&mut self, fact: &Value) -> Result<(), String> {
        let (epoch, version) = (number(fact, "epoch")?, number(fact, "version")?);
        if let Some(open) = &self.open {
            return Err(format!("epoch {} is still open", open.epoch));
        }
        match self.last {
            Some(last) => same("epoch", &(last + 1), &epoch)?,
            None if epoch > 0 && !self.account.epochs.contains_key(&(epoch - 1)) => {
                return Err("the epoch before was never complete".to_owned());
            }
            None => {}
        }
        same("version", &epoch.saturating_sub(self.lag), &version)?;
        // What a learner that died had made of it, and of all that followed, is void.
        self.account.epochs.retain(|&before, _| before < epoch);
        self.last = Some(epoch);
        self.open = Some(Open { epoch, version, target: fact["target"].clone(), ..Open::default() });
        Ok(())
    }

    fn joined(&mut self, fact: &Value, actor: &str) -> Result<(), String> {
        self.account.joined += 1;
        self.account.returned += usize::from(fact["returned"] == true);
        if self.actors.insert(actor.to_owned()) { Ok(()) } else { Err("it is here already".to_owned()) }
    }

    fn left(&mut self, leases: u64, actor: &str) -> Result<(), String> {
        if !self.actors.remove(actor) {
            return Err("it is not here".to_owned());
        }
        if self.finished {
            return Ok(());
        }
        let held = self.open.as_mut().map_or(0, |open| {
            let before = open.held.len();
            open.held.retain(|_, holder| holder != actor);
            (before - open.held.len()) as u64
        });
        self.account.lost_leases += leases;
        same("number of leases", &held, &leases)
    }

    fn leased(&mut self, fact: &Value, actor: &str) -> Result<(), String> {
        let here = self.actors.contains(actor);
        let open = self.at(fact)?;
        for episode in episodes(fact)? {
            if !here || open.accepted.contains(&episode) {
                return Err(format!("episode {episode} cannot be leased to {actor}"));
            }
            if let Some(holder) = open.held.insert(episode, actor.to_owned()) {
                return Err(format!("episode {episode} is leased to {holder}"));
            }
        }
        Ok(())
    }

    fn accepted(&mut self, fact: &Value, actor: &str) -> Result<(), String> {
        let open = self.at(fact)?;
        same("version", &open.version, &number(fact, "version")?)?;
        for episode in episodes(fact)? {
            same("holder", &open.held.remove(&episode).as_deref(), &Some(actor))?;
            if !open.accepted.insert(episode) {
                return Err(format!("episode {episode} is accepted twice"));
            }
        }
        Ok(())
    }

    fn refused(&mut self, fact: &Value) -> Result<(), String> {
        let (epoch, version, reason) = (number(fact, "epoch")?, number(fact, "version")?, text(fact, "reason")?);
        let now = self.open.as_ref().map(|open| (open.epoch, open.version));
        let expected = match now {
            Some((open, _)) if open != epoch => "late",
            None => "late",
            Some((_, needed)) if needed != version => "version",
            Some(_) => "unleased",
        };
        same("reason", &expected, &reason)?;
        *self.account.refused.entry(reason.to_owned()).or_default() += episodes(fact)?.len() as u64;
        Ok(())
    }

    fn closed(&mut self, fact: &Value) -> Result<(), String> {
        self.at(fact)?;
        let open = self.open.take().ok_or("nothing is open")?;
        same("version", &open.version, &number(fact, "version")?)?;
        let (count, steps) = (number(fact, "episodes")?, number(fact, "steps")?);
        if count == 0 || (0..count).any(|episode| !open.accepted.contains(&episode)) {
            return Err("the batch is not a prefix of what was accepted".to_owned());
        }
        same("surplus", &(open.accepted.len() as u64 - count), &number(fact, "surplus_episodes")?)?;
        let reached = open.target["steps"].as_u64().is_none_or(|target| steps >= target)
            && open.target["episodes"].as_u64().is_none_or(|target| count == target);
        if !reached {
            return Err(format!("the target was {}", open.target));
        }
        self.account.epochs.insert(open.epoch, steps);
        Ok(())
    }

    /// The open epoch, which is the one of this fact.
    fn at(&mut self, fact: &Value) -> Result<&mut Open, String> {
        let open = self.open.as_mut().ok_or("no epoch is open")?;
        same("epoch", &open.epoch, &number(fact, "epoch")?)?;
        Ok(open)
    }
}

fn same<T: PartialEq + std::fmt::Debug>(what: &str, expected: &T, found: &T) -> Result<(), String> {
    if expected == found { Ok(()) } else { Err(format!("the {what} should be {expected:?}, and is {found:?}")) }
}

fn number(fact: &Value, key: &str) -> Result<u64, String> {
    fact[key].as_u64().ok_or_else(|| format!("no number `{key}`"))
}

fn text<'a>(fact: &'a Value, key: &str) -> Result<&'a str, String> {
    fact[key].as_str().ok_or_else(|| format!("no text `{key}`"))
}

/// The numbers of the ranges under `episodes`.
fn episodes(fact: &Value) -> Result<Vec<u64>, String> {
    let ranges: Vec<[u64; 2]> =
        serde_json::from_value(fact["episodes"].clone()).map_err(|error| format!("`episodes`: {error}"))?;
    Ok(ranges.into_iter().flat_map(|[first, last]| first..=last).collect())
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    /// Two epochs of an actor and another that takes over.
    fn orderly() -> Vec<Value> {
        let target = json!({"steps": 30});
        vec![
            json!({"event": "started", "run": "r", "lag": 0}),
            json!({"event": "joined", "actor": "a", "returned": false}),
            json!({"event": "opened", "epoch": 0, "version": 0, "target": target}),
            json!({"event": "leased", "epoch": 0, "actor": "a", "episodes": [[0, 4]]}),
            json!({"event": "accepted", "epoch": 0, "version": 0, "actor": "a", "episodes": [[0, 1], [3, 3]]}),
            json!({"event": "left", "actor": "a", "leases": 2, "reason": "died"}),
            json!({"event": "joined", "actor": "b", "returned": false}),
            json!({"event": "leased", "epoch": 0, "actor": "b", "episodes": [[2, 2], [4, 4]]}),
            json!({"event": "accepted", "epoch": 0, "version": 0, "actor": "b", "episodes": [[2, 2]]}),
            json!({"event": "closed", "epoch": 0, "version": 0, "episodes": 3, "steps": 30, "surplus_episodes": 1}),
            json!({"event": "refused", "epoch": 0, "version": 0, "actor": "b", "reason": "late", "episodes": [[4, 4]]}),
            json!({"event": "opened", "epoch": 1, "version": 1, "target": target}),
            json!({"event": "leased", "epoch": 1, "actor": "b", "episodes": [[0, 0]]}),
            json!({"event": "accepted", "epoch": 1, "version": 1, "actor": "b", "episodes": [[0, 0]]}),
            json!({"event": "closed", "epoch": 1, "version": 1, "episodes": 1, "steps": 31, "surplus_episodes": 0}),
            json!({"event": "finished", "reason": "done"}),
        ]
    }

    fn check(facts: &[Value]) -> Result<Account, String> {
        let mut checker = Checker::default();
        facts.iter().try_for_each(|fact| checker.read(fact))?;
        Ok(checker.account)
    }

    #[test]
    fn an_orderly_account_is_in_order() {
        let account = check(&orderly()).unwrap();
        assert_eq!(account.epochs, BTreeMap::from([(0, 30), (1, 31)]));
        assert_eq!((account.starts, account.joined, account.lost_leases), (1, 2, 2));
        assert_eq!(account.refused, BTreeMap::from([("late".to_owned(), 1)]));
    }

    #[test]
    fn every_broken_rule_is_found() {
        let broken = [
            (4, "version", json!(1), "the version should be 0"),
            (4, "episodes", json!([[0, 5]]), "the holder should be None"),
            (4, "actor", json!("b"), "the holder"),
            (5, "leases", json!(1), "the number of leases should be 2"),
            (7, "episodes", json!([[1, 2]]), "episode 1 cannot be leased"),
            (8, "epoch", json!(1), "the epoch should be 0"),
            (9, "episodes", json!(5), "not a prefix"),
            (9, "steps", json!(29), "the target was"),
            (9, "surplus_episodes", json!(0), "the surplus should be 1"),
            (10, "reason", json!("unleased"), "the reason should be \"late\""),
            (11, "epoch", json!(2), "the epoch should be 1"),
            (11, "version", json!(0), "the version should be 1"),
            (12, "actor", json!("a"), "cannot be leased to a"),
            (1, "event", json!("started"), "no text `run`"),
        ];
        for (line, key, value, problem) in broken {
            let mut facts = orderly();
            facts[line][key] = value;
            let error = check(&facts).unwrap_err();
            assert!(error.contains(problem), "line {line}, {key}: {error}");
        }
        // The same line twice: an episode that is leased, accepted or opened again.
        for line in [1, 2, 3, 4, 5, 9, 14] {
            let mut facts = orderly();
            facts.insert(line, facts[line].clone());
            assert!(check(&facts).is_err(), "line {line} twice");
        }
    }
}

//! Environments by name.
//!
//! Every environment answers to its id (`popgym-PositionOnlyCartPoleEasy-v0`), to its short name
//! (`PositionOnlyCartPoleEasy`), and to its aliases, such as the name that the paper's tables use
//! (`StatelessCartPoleEasy`). The wrapping of an id, `popgym-...-v0`, may be put around or left off any of them.

use std::sync::Arc;

use crate::env::{Difficulty, Env, EnvSpec};
use crate::observability::{Observability, Observed};
use crate::vec_env::{Rows, Typed};

/// Makes environments of one type.
trait Make: Send + Sync {
    fn env(&self) -> Box<dyn Env>;
    fn rows(&self, observability: Observability, rows: usize) -> Result<Box<dyn Rows>, String>;
}

impl<E: Env + 'static, F: Fn() -> E + Send + Sync> Make for F {
    fn env(&self) -> Box<dyn Env> {
        Box::new(self())
    }

    fn rows(&self, observability: Observability, rows: usize) -> Result<Box<dyn Rows>, String> {
        let envs = (0..rows).map(|_| self());
        if matches!(observability, Observability::Partial | Observability::FullInInfo) {
            return Ok(Box::new(Typed::new(envs)));
        }
        let envs: Vec<_> = envs.map(|env| Observed::new(env, observability)).collect::<Result<_, _>>()?;
        Ok(Box::new(Typed::new(envs.into_iter())))
    }
}

/// One environment of a [`Registry`].
#[derive(Clone)]
pub struct Entry {
    /// The short name, for example `PositionOnlyCartPoleEasy`.
    pub name: String,
    /// Further names, for example the paper's `StatelessCartPoleEasy`.
    pub aliases: Vec<String>,
    /// The name in the paper's tables, if it is there.
    pub paper_name: Option<String>,
    /// What kind of task it is, for example `diagnostic`, `control` or `game`.
    pub group: String,
    /// The size of the game, if its name ends in one.
    pub difficulty: Option<Difficulty>,
    /// Id, spaces and limits.
    pub spec: EnvSpec,
    make: Arc<dyn Make>,
}

impl Entry {
    /// The canonical id, for example `popgym-PositionOnlyCartPoleEasy-v0`.
    pub fn id(&self) -> &str {
        &self.spec.id
    }

    /// A new environment.
    pub fn make(&self) -> Box<dyn Env> {
        self.make.env()
    }

    /// The spec at a level of observability.
    ///
    /// # Errors
    /// If there is no hidden state to show.
    pub fn observed(&self, observability: Observability) -> Result<EnvSpec, MakeError> {
        let spec = observability.apply(&self.spec);
        spec.validate().map_err(|reason| self.nothing_to_show(observability, reason))?;
        Ok(spec)
    }

    /// The rows of a [`crate::VecEnv`].
    pub(crate) fn make_rows(&self, observability: Observability, rows: usize) -> Result<Box<dyn Rows>, MakeError> {
        self.make.rows(observability, rows).map_err(|reason| self.nothing_to_show(observability, reason))
    }

    fn nothing_to_show(&self, observability: Observability, reason: String) -> MakeError {
        MakeError::Observability { id: self.id().to_owned(), observability, reason }
    }

    /// Id, short name and aliases.
    fn names(&self) -> impl Iterator<Item = &str> {
        [self.id(), &self.name].into_iter().chain(self.aliases.iter().map(String::as_str))
    }
}

impl std::fmt::Debug for Entry {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Entry").field("id", &self.id()).field("aliases", &self.aliases).finish_non_exhaustive()
    }
}

/// No environment has this name.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct UnknownEnv {
    /// The name that was asked for.
    pub name: String,
    /// The known name that is nearest to it.
    pub nearest: Option<String>,
}

impl std::error::Error for UnknownEnv {}

impl std::fmt::Display for UnknownEnv {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "unknown environment `{}`; ", self.name.escape_debug())?;
        if let Some(nearest) = &self.nearest {
            write!(f, "did you mean `{nearest}`? ")?;
        }
        f.write_str("`learner list envs` lists them all")
    }
}

/// Why an environment cannot be made.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum MakeError {
    /// There is none of this name.
    #[error(transparent)]
    Unknown(#[from] UnknownEnv),
    /// It has no hidden state.
    #[error("{id} cannot be observed at the level {observability}: {reason}")]
    Observability {
        /// The environment.
        id: String,
        /// The level asked for.
        observability: Observability,
        /// What is wrong with it.
        reason: String,
    },
}

/// Why an environment cannot be registered.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum RegisterError {
    /// Another environment has this name already.
    #[error("the name `{name}` belongs to the environment `{owner}` already")]
    Duplicate {
        /// The name.
        name: String,
        /// Who has it.
        owner: String,
    },
    /// A name is empty or holds white space.
    #[error("`{0}` cannot name an environment: it is empty or holds white space")]
    Name(String),
    /// The environment's spec makes no sense.
    #[error("the spec of the environment `{name}` is not valid: {reason}")]
    Spec {
        /// The environment's short name.
        name: String,
        /// What is wrong.
        reason: String,
    },
}

/// The environments that can be made by name, in the order in which they were registered.
#[derive(Clone, Debug, Default)]
pub struct Registry {
    entries: Vec<Entry>,
}

impl Registry {
    /// No environments.
    pub fn new() -> Self {
        Self::default()
    }

    /// Sets the name in the paper of what was registered last.
    pub(crate) fn set_paper_name(&mut self, paper_name: Option<String>) {
        if let Some(entry) = self.entries.last_mut() {
            entry.paper_name = paper_name;
        }
    }

    /// Adds an environment. `make` is called once here, to learn the id and the spaces, and whenever one is made.
    ///
    /// # Errors
    /// If one of the names, or the id that the environment itself gives, is taken or cannot be a name, or if the
    /// environment's spec is not valid. The registry is then as before.
    pub fn register<E: Env + 'static>(
        &mut self,
        name: &str,
        aliases: &[&str],
        group: &str,
        make: impl Fn() -> E + Send + Sync + 'static,
    ) -> Result<(), RegisterError> {
        let spec = make().spec().clone();
        spec.validate().map_err(|reason| RegisterError::Spec { name: name.to_owned(), reason })?;
        let entry = Entry {
            name: name.to_owned(),
            aliases: aliases.iter().map(|&alias| alias.to_owned()).collect(),
            paper_name: None,
            group: group.to_owned(),
            difficulty: Difficulty::ALL.into_iter().find(|difficulty| name.ends_with(&difficulty.to_string())),
            spec,
            make: Arc::new(make),
        };
        for name in entry.names() {
            if unwrapped(name).is_empty() || name.contains(char::is_whitespace) {
                return Err(RegisterError::Name(name.to_owned()));
            }
            if let Ok(owner) = self.get(name) {
                return Err(RegisterError::Duplicate { name: name.to_owned(), owner: owner.id().to_owned() });
            }
        }
        self.entries.push(entry);
        Ok(())
    }

    /// The environment that answers to `name`.
    ///
    /// # Errors
    /// If there is none.
    pub fn get(&self, name: &str) -> Result<&Entry, UnknownEnv> {
        let exact = self.entries.iter().find(|entry| entry.names().any(|known| known == name));
        let bare = || self.entries.iter().find(|entry| entry.names().any(|known| unwrapped(known) == unwrapped(name)));
        exact.or_else(bare).ok_or_else(|| UnknownEnv { name: name.to_owned(), nearest: self.nearest(name) })
    }

    /// The canonical id of the environment that answers to `name`.
    ///
    /// # Errors
    /// If there is none.
    pub fn canonical(&self, name: &str) -> Result<&str, UnknownEnv> {
        self.get(name).map(Entry::id)
    }

    /// A new environment that answers to `name`.
    ///
    /// # Errors
    /// If there is none.
    pub fn make(&self, name: &str) -> Result<Box<dyn Env>, UnknownEnv> {
        self.get(name).map(Entry::make)
    }

    /// All environments, in the order of registration.
    pub fn iter(&self) -> std::slice::Iter<'_, Entry> {
        self.entries.iter()
    }

    /// The known short name or alias most like `name`; the first of equals.
    fn nearest(&self, name: &str) -> Option<String> {
        let wanted = unwrapped(name).to_lowercase();
        let mut best: Option<(f64, &str)> = None;
        for known in self.entries.iter().flat_map(|entry| entry.names().skip(1)) {
            let likeness = strsim::normalized_damerau_levenshtein(&wanted, &known.to_lowercase());
            if best.is_none_or(|(most, _)| likeness > most) {
                best = Some((likeness, known));
            }
        }
        best.map(|(_, known)| known.to_owned())
    }
}

impl<'a> IntoIterator for &'a Registry {
    type Item = &'a Entry;
    type IntoIter = std::slice::Iter<'a, Entry>;

    fn into_iter(self) -> Self::IntoIter {
        self.iter()
    }
}

/// `name` without `popgym-` and `-v0`.
fn unwrapped(name: &str) -> &str {
    let name = name.strip_prefix("popgym-").unwrap_or(name);
    name.strip_suffix("-v0").unwrap_or(name)
}

//! Why a message is refused.

/// What is wrong with a message: the field, what it holds, what is allowed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum WireError {
    /// A field that must be there is not.
    #[error("{field} is missing")]
    Missing {
        /// The field.
        field: &'static str,
    },
    /// A value that is not allowed.
    #[error("{field} is {value}, allowed is {allowed}")]
    Value {
        /// The field.
        field: &'static str,
        /// What it holds.
        value: String,
        /// What it may hold.
        allowed: String,
    },
    /// A block or list of the wrong length.
    #[error("{field} has length {length}, allowed is {allowed}")]
    Length {
        /// The field.
        field: &'static str,
        /// Its length, in bytes (blocks), characters (names) or elements (lists).
        length: usize,
        /// What it may be.
        allowed: String,
    },
    /// One of many values is not allowed.
    #[error("{field}[{at}] is {value}, allowed is {allowed}")]
    Element {
        /// The field.
        field: &'static str,
        /// Index into the block, counted in values.
        at: usize,
        /// The value there.
        value: String,
        /// What it may be.
        allowed: String,
    },
    /// A text that should be TOML is not.
    #[error("{field} is not TOML: {problem}")]
    Toml {
        /// The field.
        field: &'static str,
        /// What the parser says.
        problem: String,
    },
    /// Weights that are not safetensors.
    #[error("{field} is not safetensors: {problem}")]
    Weights {
        /// The field.
        field: &'static str,
        /// What the parser says.
        problem: String,
    },
}

impl WireError {
    /// What kind of error this is: a label for metrics, one of a handful.
    pub fn reason(&self) -> &'static str {
        match self {
            Self::Missing { .. } => "missing",
            Self::Value { .. } => "value",
            Self::Length { .. } => "length",
            Self::Element { .. } => "element",
            Self::Toml { .. } => "toml",
            Self::Weights { .. } => "weights",
        }
    }
}

/// Checks that `value` lies within `allowed`.
pub(crate) fn within<T>(field: &'static str, value: T, allowed: std::ops::RangeInclusive<T>) -> Result<T, WireError>
where
    T: PartialOrd + std::fmt::Display,
{
    if allowed.contains(&value) {
        return Ok(value);
    }
    let allowed = format!("{}..={}", allowed.start(), allowed.end());
    Err(WireError::Value { field, value: value.to_string(), allowed })
}

/// Checks a name: `min..=128` characters, none of them white space or control characters.
pub(crate) fn name(field: &'static str, value: String, min: usize) -> Result<String, WireError> {
    let chars = value.chars().count();
    if !(min..=crate::limits::MAX_NAME_CHARS).contains(&chars) {
        let allowed = format!("{min}..={} characters", crate::limits::MAX_NAME_CHARS);
        return Err(WireError::Length { field, length: chars, allowed });
    }
    if value.chars().any(|c| c.is_whitespace() || c.is_control()) {
        let allowed = "a name without white space".to_owned();
        return Err(WireError::Value { field, value: format!("`{}`", value.escape_debug()), allowed });
    }
    Ok(value)
}

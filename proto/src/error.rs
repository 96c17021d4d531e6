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
    /// Bytes that are not a message of protobuf.
    #[error("{field} is no message: {problem}")]
    Encoding {
        /// The field.
        field: &'static str,
        /// What the decoder says.
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
            Self::Encoding { .. } => "encoding",
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

/// Checks a name: `min..=128` characters, all of them visible wherever they are shown: no white space, nothing that controls a
/// terminal or turns the direction of a line.
///
/// # Errors
/// What is wrong with it, as that of the field `field`.
pub fn name(field: &'static str, value: String, min: usize) -> Result<String, WireError> {
    let chars = value.chars().count();
    if !(min..=crate::limits::MAX_NAME_CHARS).contains(&chars) {
        let allowed = format!("{min}..={} characters", crate::limits::MAX_NAME_CHARS);
        return Err(WireError::Length { field, length: chars, allowed });
    }
    // What Rust's own escapes leave as it is; quotation marks and backslashes they escape for other reasons.
    let visible = |c: char| !c.is_whitespace() && (c.escape_debug().len() == 1 || matches!(c, '\'' | '"' | '\\'));
    if !value.chars().all(visible) {
        let allowed = "a name without white space and invisible characters".to_owned();
        return Err(WireError::Value { field, value: format!("`{}`", value.escape_debug()), allowed });
    }
    Ok(value)
}

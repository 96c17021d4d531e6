//! What configurations and study files have in common.

use popgym_learner::Extensions;
use toml::{Table, Value};

thread_local! {
    static EXTENSIONS: Extensions = Extensions::default();
}

/// Calls `read` with the environments and memories of popgym-rs.
pub(crate) fn with_extensions<T>(read: impl FnOnce(&Extensions) -> T) -> T {
    EXTENSIONS.with(read)
}

/// The text, if it is TOML, and none that is slow by right: a memory that may be large, and is built before it is known to
/// be fit for use. What is larger than any memory may be is refused at once, and so is kept.
pub(crate) fn quick_text(data: &[u8]) -> Option<(&str, Table)> {
    let text = std::str::from_utf8(data).ok()?;
    let table: Table = text.parse().ok()?;
    let quick = !holds_large_memory(&Value::Table(table.clone()));
    quick.then_some((text, table))
}

fn holds_large_memory(value: &Value) -> bool {
    match value {
        Value::Table(table) => table.iter().any(|(key, value)| {
            let large = key == "memory" && value.as_table().is_some_and(is_large);
            large || holds_large_memory(value)
        }),
        Value::Array(values) => values.iter().any(holds_large_memory),
        _ => false,
    }
}

/// Options of a memory that is larger than most: legal sizes, one of them above 512 or all of them together above 2^19.
fn is_large(memory: &Table) -> bool {
    let sizes = memory.values().filter_map(Value::as_integer).filter(|size| (1..=4096).contains(size));
    let sizes: Vec<i64> = sizes.collect();
    sizes.iter().any(|&size| size > 512)
        || sizes.iter().fold(1, |product: i64, &size| product.saturating_mul(size)) > 1 << 19
}

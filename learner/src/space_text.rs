//! Spaces and their points in words.

use popgym_envs::space::Leaf;
use popgym_envs::{Space, Value};

/// A space in a few characters: `Discrete(4)`, `MultiDiscrete[8,8]`, `MultiDiscrete[3]*52`, `Box(2)`, `Tuple(.., ..)`.
pub fn space_text(space: &Space) -> String {
    match space {
        Space::Discrete(classes) => format!("Discrete({classes})"),
        Space::MultiDiscrete(classes) => format!("MultiDiscrete{}", runs(classes)),
        Space::Box { low, .. } => format!("Box({})", low.len()),
        Space::Tuple(parts) => format!("Tuple({})", parts.iter().map(space_text).collect::<Vec<_>>().join(", ")),
    }
}

/// `[8,8]`; where a class count is repeated more than three times, `[3]*52`, with `+` before what follows.
fn runs(classes: &[u16]) -> String {
    const LONG: usize = 4;
    let mut parts: Vec<String> = Vec::new();
    let mut short: Vec<String> = Vec::new();
    for run in classes.chunk_by(|a, b| a == b) {
        if run.len() < LONG {
            short.extend(run.iter().map(u16::to_string));
            continue;
        }
        if !short.is_empty() {
            parts.push(format!("[{}]", short.join(",")));
            short.clear();
        }
        parts.push(format!("[{}]*{}", run[0], run.len()));
    }
    if !short.is_empty() || parts.is_empty() {
        parts.push(format!("[{}]", short.join(",")));
    }
    parts.join("+")
}

/// A point of `space` in numbers: components apart by blanks, parts of a tuple by bars.
pub fn value_text(space: &Space, value: Value<'_>) -> String {
    let Space::Tuple(parts) = space else {
        let (mut discrete, mut real) = (value.discrete.iter(), value.real.iter());
        let numbers = space.leaves().into_iter().map(|leaf| match leaf {
            Leaf::Discrete { .. } => discrete.next().map_or_else(String::new, u8::to_string),
            Leaf::Real { .. } => real.next().map_or_else(String::new, |&x| number(f64::from(x))),
        });
        return numbers.collect::<Vec<_>>().join(" ");
    };
    let (mut discrete, mut real) = (value.discrete, value.real);
    let texts = parts.iter().map(|part| {
        let (own_discrete, rest) = discrete.split_at(part.discrete_width());
        let (own_real, rest_real) = real.split_at(part.real_width());
        (discrete, real) = (rest, rest_real);
        value_text(part, Value { discrete: own_discrete, real: own_real })
    });
    texts.collect::<Vec<_>>().join(" | ")
}

/// A real with four places, or in powers of ten where those would be many digits.
pub fn number(x: f64) -> String {
    if x.abs() < 1e6 { format!("{x:.4}") } else { format!("{x:.3e}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spaces() {
        let multi = |classes: &[u16]| space_text(&Space::MultiDiscrete(classes.to_vec()));
        assert_eq!(space_text(&Space::Discrete(4)), "Discrete(4)");
        assert_eq!(multi(&[8, 8]), "MultiDiscrete[8,8]");
        assert_eq!(multi(&[3; 52]), "MultiDiscrete[3]*52");
        assert_eq!(multi(&[2, 2, 2]), "MultiDiscrete[2,2,2]");
        assert_eq!(multi(&[5, 5, 2, 2, 2, 2, 9]), "MultiDiscrete[5,5]+[2]*4+[9]");
        assert_eq!(multi(&[]), "MultiDiscrete[]");
        let tuple = Space::Tuple(vec![Space::uniform_box(2, 0.0, 1.0), Space::Discrete(13)]);
        assert_eq!(space_text(&tuple), "Tuple(Box(2), Discrete(13))");
    }

    #[test]
    fn values() {
        let boxes = Space::uniform_box(2, -9.0, 9.0);
        let tuple = Space::Tuple(vec![boxes, Space::Discrete(13), Space::MultiDiscrete(vec![2, 3])]);
        let value = Value { discrete: &[12, 1, 2], real: &[0.25, -3.0] };
        assert_eq!(value_text(&tuple, value), "0.2500 -3.0000 | 12 | 1 2");
        assert_eq!(value_text(&Space::Discrete(4), Value { discrete: &[3], real: &[] }), "3");
        assert_eq!(number(3.4e38), "3.400e38");
    }
}

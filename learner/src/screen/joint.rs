//! Actions of one or two discrete components by one number, as pictures number them.

use popgym_envs::Space;
use popgym_envs::space::Leaf;
use popgym_models::Marginals;

/// The actions of a space that has one or two discrete components and no other: number `a` or `a * n1 + b`
/// ([`popgym_envs::canvas::Glyph::action`]).
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Joint {
    classes: Vec<u16>,
}

impl Joint {
    /// The actions of `space`, if it has them.
    pub(crate) fn of(space: &Space) -> Option<Self> {
        let classes = space.leaves().into_iter().map(|leaf| match leaf {
            Leaf::Discrete { classes } => Some(classes),
            Leaf::Real { .. } => None,
        });
        let classes: Vec<u16> = classes.collect::<Option<_>>()?;
        (1..=2).contains(&classes.len()).then_some(Self { classes })
    }

    /// How many there are.
    pub(crate) fn count(&self) -> usize {
        self.classes.iter().copied().map(usize::from).product()
    }

    /// Number of components.
    pub(crate) fn components(&self) -> usize {
        self.classes.len()
    }

    /// The classes of action `index`.
    pub(crate) fn classes(&self, index: usize) -> Vec<u8> {
        match self.classes[..] {
            [_, second] => vec![(index / usize::from(second)) as u8, (index % usize::from(second)) as u8],
            _ => vec![index as u8],
        }
    }

    /// The number of the action with these classes.
    pub(crate) fn index(&self, classes: &[u8]) -> usize {
        let numbers = classes.iter().zip(&self.classes);
        numbers.fold(0, |index, (&class, &count)| index * usize::from(count) + usize::from(class))
    }

    /// The probability of each action; components are independent.
    pub(crate) fn probabilities(marginals: &Marginals) -> Vec<f64> {
        match &marginals.classes[..] {
            [first, second] => first.iter().flat_map(|p| second.iter().map(move |q| p * q)).collect(),
            [only] => only.clone(),
            _ => Vec::new(),
        }
    }

    /// What action `index` is called: its name if there is one, else its classes.
    pub(crate) fn name(&self, index: usize, names: &[&str]) -> String {
        match (names.get(index), &self.classes(index)[..]) {
            (Some(name), [_]) => (*name).to_owned(),
            (_, [first, second]) => format!("({first}, {second})"),
            _ => index.to_string(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_and_classes() {
        let board = Joint::of(&Space::MultiDiscrete(vec![3, 5])).unwrap();
        assert_eq!((board.count(), board.classes(13), board.index(&[2, 3])), (15, vec![2, 3], 13));
        assert_eq!((board.name(13, &["no", "use"]), board.components()), ("(2, 3)".to_owned(), 2));
        let cards = Joint::of(&Space::Discrete(4)).unwrap();
        assert_eq!((cards.count(), cards.classes(3), cards.index(&[3])), (4, vec![3], 3));
        assert_eq!((cards.name(1, &["left", "right"]), cards.name(3, &[])), ("right".to_owned(), "3".to_owned()));
        for other in [Space::uniform_box(1, 0.0, 1.0), Space::MultiDiscrete(vec![2; 3]), Space::Tuple(Vec::new())] {
            assert_eq!(Joint::of(&other), None);
        }
        // The largest that can be.
        let board = Joint::of(&Space::MultiDiscrete(vec![256, 256])).unwrap();
        assert_eq!((board.classes(65535), board.index(&[255, 255])), (vec![255, 255], 65535));
    }

    #[test]
    fn probabilities_multiply() {
        let classes = vec![vec![0.25, 0.75], vec![0.5, 0.5]];
        let marginals = Marginals { classes, reals: Vec::new(), entropy: 0.0 };
        assert_eq!(Joint::probabilities(&marginals), [0.125, 0.125, 0.375, 0.375]);
    }
}

//! Spaces: what an observation, an action or a hidden state may be.
//!
//! A point of any space is stored in two flat parts, in the order of the space's leaves: one byte for each discrete
//! component and one `f32` for each real one. Slabs, wires and tensors carry these bytes; one-hot vectors are made
//! only where a network reads them ([`Space::flatten_into`]).

use std::convert::Infallible;

use serde::{Deserialize, Serialize};

use crate::rng::{EpisodeRng, below, uniform};

/// Largest number of classes of one discrete component: a class is stored in one byte.
pub const MAX_CLASSES: u16 = 256;

/// A set of values, in the sense of Gymnasium's spaces.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Space {
    /// One of `0..n`.
    Discrete(u16),
    /// A vector of discrete components, component `i` one of `0..n[i]`.
    MultiDiscrete(Vec<u16>),
    /// A vector of reals, component `i` within `low[i]..=high[i]` (bounds may be infinite).
    Box {
        /// Lower bounds, one a component.
        low: Vec<f32>,
        /// Upper bounds, one a component.
        high: Vec<f32>,
    },
    /// A sequence of spaces.
    Tuple(Vec<Space>),
}

/// One component of a space, in order.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Leaf {
    /// A class in `0..classes`.
    Discrete {
        /// Number of classes.
        classes: u16,
    },
    /// A real within `low..=high`.
    Real {
        /// Lower bound.
        low: f32,
        /// Upper bound.
        high: f32,
    },
}

/// Why a value is not a point of a space.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SpaceError {
    /// Wrong number of discrete or real components.
    #[error("expected {expected_discrete} discrete and {expected_real} real components, got {discrete} and {real}")]
    Width {
        /// Discrete components of the space.
        expected_discrete: usize,
        /// Real components of the space.
        expected_real: usize,
        /// Discrete components given.
        discrete: usize,
        /// Real components given.
        real: usize,
    },
    /// A class outside its range.
    #[error("discrete component {index} is {value}, allowed is 0..{classes}")]
    Class {
        /// Index among the discrete components.
        index: usize,
        /// The class given.
        value: u8,
        /// Number of classes.
        classes: u16,
    },
    /// A real that is not finite or is out of bounds.
    #[error("real component {index} is {value}, allowed is {low}..={high}")]
    Real {
        /// Index among the real components.
        index: usize,
        /// The value given.
        value: f32,
        /// Lower bound.
        low: f32,
        /// Upper bound.
        high: f32,
    },
}

/// A borrowed point of a space.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Value<'a> {
    /// Classes of the discrete components.
    pub discrete: &'a [u8],
    /// The real components.
    pub real: &'a [f32],
}

/// A borrowed point of a space, to be written.
#[derive(Debug, Default)]
pub struct ValueMut<'a> {
    /// Classes of the discrete components.
    pub discrete: &'a mut [u8],
    /// The real components.
    pub real: &'a mut [f32],
}

impl ValueMut<'_> {
    /// The first components, as many discrete and real ones as `widths` says, and the others.
    ///
    /// # Panics
    /// If there are fewer.
    #[inline]
    #[must_use]
    pub fn split_at(self, widths: (usize, usize)) -> [Self; 2] {
        let (discrete, rest_discrete) = self.discrete.split_at_mut(widths.0);
        let (real, rest_real) = self.real.split_at_mut(widths.1);
        [Self { discrete, real }, Self { discrete: rest_discrete, real: rest_real }]
    }

    /// Copies `value` here.
    ///
    /// # Panics
    /// If it has other widths.
    #[inline]
    pub fn copy_from(&mut self, value: Value<'_>) {
        self.discrete.copy_from_slice(value.discrete);
        self.real.copy_from_slice(value.real);
    }
}

/// Many points of one space, row after row: the storage that callers own and environments write into.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Slab {
    discrete_width: usize,
    real_width: usize,
    /// `[rows, discrete_width]` classes, row-major.
    pub discrete: Vec<u8>,
    /// `[rows, real_width]` reals, row-major.
    pub real: Vec<f32>,
}

impl Space {
    /// An unbounded or bounded vector of `n` reals, all with the same bounds.
    pub fn uniform_box(n: usize, low: f32, high: f32) -> Self {
        Self::Box { low: vec![low; n], high: vec![high; n] }
    }

    /// Calls `visit` with each component in order, until it fails. Does not allocate.
    ///
    /// # Errors
    /// The first error of `visit`.
    pub fn try_for_each_leaf<E>(&self, visit: &mut impl FnMut(Leaf) -> Result<(), E>) -> Result<(), E> {
        match self {
            Self::Discrete(classes) => visit(Leaf::Discrete { classes: *classes }),
            Self::MultiDiscrete(n) => n.iter().try_for_each(|&classes| visit(Leaf::Discrete { classes })),
            Self::Box { low, high } => {
                low.iter().zip(high).try_for_each(|(&low, &high)| visit(Leaf::Real { low, high }))
            }
            Self::Tuple(parts) => parts.iter().try_for_each(|part| part.try_for_each_leaf(visit)),
        }
    }

    fn for_each_leaf(&self, mut visit: impl FnMut(Leaf)) {
        let Ok(()) = self.try_for_each_leaf::<Infallible>(&mut |leaf| {
            visit(leaf);
            Ok(())
        });
    }

    /// The components in order.
    pub fn leaves(&self) -> Vec<Leaf> {
        let mut leaves = Vec::new();
        self.for_each_leaf(|leaf| leaves.push(leaf));
        leaves
    }

    /// Number of discrete components.
    #[inline]
    pub fn discrete_width(&self) -> usize {
        match self {
            Self::Discrete(_) => 1,
            Self::MultiDiscrete(n) => n.len(),
            Self::Box { .. } => 0,
            Self::Tuple(parts) => parts.iter().map(Self::discrete_width).sum(),
        }
    }

    /// Number of real components.
    #[inline]
    pub fn real_width(&self) -> usize {
        match self {
            Self::Discrete(_) | Self::MultiDiscrete(_) => 0,
            Self::Box { low, .. } => low.len(),
            Self::Tuple(parts) => parts.iter().map(Self::real_width).sum(),
        }
    }

    /// Number of discrete and of real components.
    #[inline]
    pub fn widths(&self) -> (usize, usize) {
        (self.discrete_width(), self.real_width())
    }

    /// Length of the one-hot vector of [`Space::flatten_into`].
    pub fn flat_width(&self) -> usize {
        let mut width = 0;
        self.for_each_leaf(|leaf| match leaf {
            Leaf::Discrete { classes } => width += usize::from(classes),
            Leaf::Real { .. } => width += 1,
        });
        width
    }

    /// Checks that the space itself makes sense: `1..=256` classes, as many lower as upper bounds, no NaN, low <= high.
    ///
    /// # Errors
    /// A sentence that names the offending component.
    pub fn validate(&self) -> Result<(), String> {
        if let Self::Box { low, high } = self
            && low.len() != high.len()
        {
            return Err(format!("a box has {} lower and {} upper bounds", low.len(), high.len()));
        }
        if let Self::Tuple(parts) = self {
            return parts.iter().try_for_each(Self::validate);
        }
        for (index, leaf) in self.leaves().iter().enumerate() {
            match *leaf {
                Leaf::Discrete { classes } if classes == 0 || classes > MAX_CLASSES => {
                    return Err(format!("component {index} has {classes} classes, allowed is 1..={MAX_CLASSES}"));
                }
                Leaf::Real { low, high } if low.is_nan() || high.is_nan() || low > high => {
                    return Err(format!("component {index} has the bounds {low}..={high}"));
                }
                _ => {}
            }
        }
        Ok(())
    }

    /// Checks that `value` is a point of this space. Does not allocate.
    ///
    /// # Errors
    /// The first component that is not.
    #[inline]
    pub fn check(&self, value: Value<'_>) -> Result<(), SpaceError> {
        let (expected_discrete, expected_real) = self.widths();
        if value.discrete.len() != expected_discrete || value.real.len() != expected_real {
            return Err(SpaceError::Width {
                expected_discrete,
                expected_real,
                discrete: value.discrete.len(),
                real: value.real.len(),
            });
        }
        self.check_from(value, &mut 0, &mut 0)
    }

    /// Checks the part of `value` from component `discrete` and `real` on, and moves both past it. The widths fit.
    #[inline]
    fn check_from(&self, value: Value<'_>, discrete: &mut usize, real: &mut usize) -> Result<(), SpaceError> {
        let mut class = |classes: u16| {
            let (index, class) = (*discrete, value.discrete[*discrete]);
            *discrete += 1;
            if u16::from(class) < classes { Ok(()) } else { Err(SpaceError::Class { index, value: class, classes }) }
        };
        match self {
            Self::Discrete(classes) => class(*classes),
            Self::MultiDiscrete(n) => n.iter().try_for_each(|&classes| class(classes)),
            Self::Box { low, high } => low.iter().zip(high).try_for_each(|(&low, &high)| {
                let (index, value) = (*real, value.real[*real]);
                *real += 1;
                let inside = value.is_finite() && low <= value && value <= high;
                if inside { Ok(()) } else { Err(SpaceError::Real { index, value, low, high }) }
            }),
            Self::Tuple(parts) => parts.iter().try_for_each(|part| part.check_from(value, discrete, real)),
        }
    }

    /// Whether every row of `slab`, which has this space's widths, is a point of this space. Faster than a check of each
    /// row where all components have the same range.
    #[allow(clippy::needless_bitwise_bool, reason = "without branches, many components are compared at once")]
    pub(crate) fn holds_all(&self, slab: &Slab) -> bool {
        let below = |classes: u16| u16::from(slab.discrete.iter().copied().fold(0, u8::max)) < classes;
        match self {
            Self::Discrete(classes) => below(*classes),
            Self::MultiDiscrete(n) if n.iter().all(|classes| *classes == n[0]) => n.is_empty() || below(n[0]),
            Self::Box { low, high } if low.len() == 1 => {
                slab.real.iter().fold(true, |all, &x| all & (x.is_finite() && low[0] <= x && x <= high[0]))
            }
            _ => (0..slab.rows()).all(|row| self.check(slab.row(row)).is_ok()),
        }
    }

    /// Draws each row of `slab` uniformly, as [`Space::sample_into`] does.
    ///
    /// # Panics
    /// If the slab's rows have another width than the space.
    pub fn sample_rows(&self, rng: &mut EpisodeRng, slab: &mut Slab) {
        match self {
            Self::Discrete(classes) if slab.widths() == (1, 0) => {
                slab.discrete.iter_mut().for_each(|out| *out = below(rng, u32::from(*classes)) as u8);
            }
            Self::MultiDiscrete(n) if !n.is_empty() && slab.widths() == (n.len(), 0) => {
                for row in slab.discrete.chunks_exact_mut(n.len()) {
                    row.iter_mut().zip(n).for_each(|(out, &classes)| *out = below(rng, u32::from(classes)) as u8);
                }
            }
            Self::Box { low, high } if slab.widths() == (0, 1) && low.len() == 1 => {
                slab.real.iter_mut().for_each(|out| *out = within(rng, low[0], high[0]));
            }
            _ => (0..slab.rows()).for_each(|row| self.sample_into(rng, slab.row_mut(row))),
        }
    }

    /// Writes the flat form of `value` (each discrete component one-hot, each real as it is, in the order of the
    /// leaves) into `out`, of length [`Space::flat_width`].
    pub fn flatten_into(&self, value: Value<'_>, out: &mut [f32]) {
        let (mut discrete, mut real, mut at) = (0, 0, 0);
        self.for_each_leaf(|leaf| match leaf {
            Leaf::Discrete { classes } => {
                let end = at + usize::from(classes);
                out[at..end].fill(0.0);
                out[at + usize::from(value.discrete[discrete])] = 1.0;
                (discrete, at) = (discrete + 1, end);
            }
            Leaf::Real { .. } => {
                out[at] = value.real[real];
                (real, at) = (real + 1, at + 1);
            }
        });
    }

    /// Draws a point uniformly into `out` (the random policy, if this is an action space).
    ///
    /// # Panics
    /// If `out` has another width than the space.
    #[inline]
    #[allow(clippy::needless_pass_by_value, reason = "a borrow is passed on as elsewhere")]
    pub fn sample_into(&self, rng: &mut EpisodeRng, out: ValueMut<'_>) {
        let ValueMut { discrete, real } = out;
        assert!(discrete.len() == self.discrete_width() && real.len() == self.real_width(), "one place a component");
        self.sample_from(rng, &mut discrete.iter_mut(), &mut real.iter_mut());
    }

    #[inline]
    fn sample_from(
        &self,
        rng: &mut EpisodeRng,
        discrete: &mut std::slice::IterMut<'_, u8>,
        real: &mut std::slice::IterMut<'_, f32>,
    ) {
        match self {
            Self::Discrete(classes) => {
                discrete.by_ref().take(1).for_each(|out| *out = below(rng, u32::from(*classes)) as u8);
            }
            Self::MultiDiscrete(n) => {
                // The space's components come first: `zip` takes one place for each of them and no more.
                n.iter().zip(discrete).for_each(|(&classes, out)| *out = below(rng, u32::from(classes)) as u8);
            }
            Self::Box { low, high } => {
                low.iter().zip(high).zip(real).for_each(|((&low, &high), out)| *out = within(rng, low, high));
            }
            Self::Tuple(parts) => parts.iter().for_each(|part| part.sample_from(rng, discrete, real)),
        }
    }
}

/// Uniform in `low..=high`.
#[inline]
fn within(rng: &mut EpisodeRng, low: f32, high: f32) -> f32 {
    // An unbounded side is taken as the largest f32, so that the result is always a point of the space.
    let (low, high) = (low.max(f32::MIN), high.min(f32::MAX));
    let x = uniform(rng, f64::from(low), f64::from(high)) as f32;
    x.clamp(low, high)
}

impl Slab {
    /// `rows` points of `space`, all zero.
    pub fn new(space: &Space, rows: usize) -> Self {
        let (discrete_width, real_width) = space.widths();
        Self {
            discrete_width,
            real_width,
            discrete: vec![0; rows * discrete_width],
            real: vec![0.0; rows * real_width],
        }
    }

    /// Discrete and real components of each row.
    #[inline]
    pub fn widths(&self) -> (usize, usize) {
        (self.discrete_width, self.real_width)
    }

    /// Number of rows (0 if the space has no component).
    pub fn rows(&self) -> usize {
        let discrete = self.discrete.len().checked_div(self.discrete_width);
        discrete.or_else(|| self.real.len().checked_div(self.real_width)).unwrap_or(0)
    }

    /// Row `row`.
    #[inline]
    pub fn row(&self, row: usize) -> Value<'_> {
        Value {
            discrete: &self.discrete[row * self.discrete_width..][..self.discrete_width],
            real: &self.real[row * self.real_width..][..self.real_width],
        }
    }

    /// Row `row`, to be written.
    #[inline]
    pub fn row_mut(&mut self, row: usize) -> ValueMut<'_> {
        ValueMut {
            discrete: &mut self.discrete[row * self.discrete_width..][..self.discrete_width],
            real: &mut self.real[row * self.real_width..][..self.real_width],
        }
    }

    /// The rows in order, without end if the space has no component.
    pub(crate) fn each_row(&self) -> impl Iterator<Item = Value<'_>> {
        let (mut discrete, mut real) = (&*self.discrete, &*self.real);
        std::iter::from_fn(move || {
            let discrete = discrete.split_off(..self.discrete_width)?;
            Some(Value { discrete, real: real.split_off(..self.real_width)? })
        })
    }

    /// The rows in order, to be written, without end if the space has no component.
    pub(crate) fn each_row_mut(&mut self) -> impl Iterator<Item = ValueMut<'_>> {
        let (mut discrete, mut real) = (&mut *self.discrete, &mut *self.real);
        let (discrete_width, real_width) = (self.discrete_width, self.real_width);
        std::iter::from_fn(move || {
            let discrete = discrete.split_off_mut(..discrete_width)?;
            Some(ValueMut { discrete, real: real.split_off_mut(..real_width)? })
        })
    }

    /// Appends a row.
    #[inline]
    pub fn push(&mut self, value: Value<'_>) {
        self.discrete.extend_from_slice(value.discrete);
        self.real.extend_from_slice(value.real);
    }

    /// Copies `value` into row `row`.
    #[inline]
    pub fn set(&mut self, row: usize, value: Value<'_>) {
        self.row_mut(row).copy_from(value);
    }

    /// Removes all rows, keeping the storage.
    pub fn clear(&mut self) {
        self.discrete.clear();
        self.real.clear();
    }
}

//! From what the agent sees to one vector: observation, previous action and first-step flag, discrete parts one-hot.
//!
//! Layout: `[observation | previous action | not first, first]`, as in POPGym's `Antialias(PreviousAction(env))`
//! flattened. On the first step the previous action is the null action: zeros where the space allows them, else
//! its lower bounds.

use popgym_envs::space::{Leaf, Slab, Space, Value};
use tch::{Device, Kind, Tensor};

/// Turns observations into the network's input vectors.
#[derive(Debug)]
pub struct Encoder {
    width: usize,
    /// Of each discrete component (observation, previous action, flag): where its classes start in the vector.
    class_offsets: Vec<usize>,
    /// Of each real component (observation, previous action): its place in the vector.
    real_positions: Vec<usize>,
    null_action: Slab,
    class_offsets_tensor: Tensor,
    real_positions_tensor: Tensor,
}

impl Encoder {
    /// An encoder for an environment with these spaces, its tensors on `device`.
    pub fn new(observation: &Space, action: &Space, device: Device) -> Self {
        let mut encoder = Self {
            width: 0,
            class_offsets: Vec::new(),
            real_positions: Vec::new(),
            null_action: null_action(action),
            class_offsets_tensor: Tensor::new(),
            real_positions_tensor: Tensor::new(),
        };
        let flag = Space::Discrete(2);
        for leaf in [observation, action, &flag].into_iter().flat_map(Space::leaves) {
            match leaf {
                Leaf::Discrete { classes } => {
                    encoder.class_offsets.push(encoder.width);
                    encoder.width += usize::from(classes);
                }
                Leaf::Real { .. } => {
                    encoder.real_positions.push(encoder.width);
                    encoder.width += 1;
                }
            }
        }
        encoder.class_offsets_tensor = index_tensor(&encoder.class_offsets, device);
        encoder.real_positions_tensor = index_tensor(&encoder.real_positions, device);
        encoder
    }

    /// Length of an input vector.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Number of discrete components of a row: observation, previous action, flag.
    pub fn discrete_width(&self) -> usize {
        self.class_offsets.len()
    }

    /// Number of real components of a row: observation, previous action.
    pub fn real_width(&self) -> usize {
        self.real_positions.len()
    }

    /// Writes one input vector (length [`Encoder::width`]). `previous_action` is the action that the environment
    /// received; it is ignored on the first step.
    pub fn encode(&self, observation: Value<'_>, previous_action: Value<'_>, first: bool, out: &mut [f32]) {
        let previous_action = if first { self.null_action.row(0) } else { previous_action };
        out.fill(0.0);
        let flag = [u8::from(first)];
        let classes = observation.discrete.iter().chain(previous_action.discrete).chain(&flag);
        for (&offset, &class) in self.class_offsets.iter().zip(classes) {
            out[offset + usize::from(class)] = 1.0;
        }
        for (&position, &x) in self.real_positions.iter().zip(observation.real.iter().chain(previous_action.real)) {
            out[position] = x;
        }
    }

    /// Appends one row of components (not yet one-hot): `discrete` grows by [`Encoder::discrete_width`] and `real` by
    /// [`Encoder::real_width`]. Arguments as in [`Encoder::encode`].
    pub fn append_row(
        &self,
        observation: Value<'_>,
        previous_action: Value<'_>,
        first: bool,
        discrete: &mut Vec<u8>,
        real: &mut Vec<f32>,
    ) {
        let previous_action = if first { self.null_action.row(0) } else { previous_action };
        discrete.extend_from_slice(observation.discrete);
        discrete.extend_from_slice(previous_action.discrete);
        discrete.push(u8::from(first));
        real.extend_from_slice(observation.real);
        real.extend_from_slice(previous_action.real);
    }

    /// Input vectors `[rows, width]` from the components of [`Encoder::append_row`]: `discrete` u8
    /// `[rows, discrete_width]`, `real` f32 `[rows, real_width]`, on the encoder's device.
    pub fn features(&self, discrete: &Tensor, real: &Tensor) -> Tensor {
        let rows = discrete.size()[0];
        let mut out = Tensor::zeros([rows, self.width as i64], (Kind::Float, discrete.device()));
        let classes = discrete.to_kind(Kind::Int64) + &self.class_offsets_tensor;
        let _ = out.scatter_value_(1, &classes, 1.0);
        if !self.real_positions.is_empty() {
            let _ = out.index_copy_(1, &self.real_positions_tensor, real);
        }
        out
    }
}

/// [`Encoder::features`] from plain numbers and of libtorch's operators alone, for a policy that leaves this program.
///
/// A row holds the numbers of the space's components in their order: the class of a discrete one, the value of a real one.
#[derive(Debug)]
pub(crate) struct NumberEncoder {
    observation: Vec<Leaf>,
    action: Vec<Leaf>,
    null_action: Tensor,
}

impl NumberEncoder {
    /// For the same spaces as an [`Encoder`].
    pub(crate) fn new(observation: &Space, action: &Space) -> Self {
        let null = null_action(action);
        let mut real = null.real.iter();
        let number = |leaf: &Leaf| match leaf {
            Leaf::Discrete { .. } => 0.0,
            Leaf::Real { .. } => *real.next().expect("as many as there are real leaves"),
        };
        let action: Vec<Leaf> = action.leaves().into_iter().collect();
        let numbers: Vec<f32> = action.iter().map(number).collect();
        let null_action = Tensor::from_slice(&numbers).view([1, -1]);
        Self { observation: observation.leaves().into_iter().collect(), action, null_action }
    }

    /// Components of an observation and of an action.
    pub(crate) fn components(&self) -> (usize, usize) {
        (self.observation.len(), self.action.len())
    }

    /// Input vectors `[rows, width]` from `observation [rows, components]`, `previous_action [rows, components]` (not looked
    /// at where `first`) and `first [rows]` (bool).
    pub(crate) fn features(&self, observation: &Tensor, previous_action: &Tensor, first: &Tensor) -> Tensor {
        let first = first.unsqueeze(1);
        let previous_action = self.null_action.where_self(&first, previous_action);
        let flags = Tensor::cat(&[first.logical_not(), first], 1).to_kind(Kind::Float);
        let mut parts = one_hot(observation, &self.observation);
        parts.extend(one_hot(&previous_action, &self.action));
        parts.push(flags);
        Tensor::cat(&parts, 1)
    }
}

/// The columns of `numbers`, those of discrete components one-hot: a tensor for each run of equal components.
fn one_hot(numbers: &Tensor, leaves: &[Leaf]) -> Vec<Tensor> {
    let classes = |leaf: &Leaf| match leaf {
        Leaf::Discrete { classes } => Some(i64::from(*classes)),
        Leaf::Real { .. } => None,
    };
    let mut at = 0;
    let runs = leaves.chunk_by(|a, b| classes(a) == classes(b)).map(|run| {
        let count = run.len() as i64;
        let columns = numbers.narrow(1, at, count);
        at += count;
        match classes(&run[0]) {
            None => columns,
            Some(classes) => {
                let each = Tensor::arange(classes, (Kind::Float, Device::Cpu));
                columns.unsqueeze(2).eq_tensor(&each).to_kind(Kind::Float).view([-1, count * classes])
            }
        }
    });
    runs.collect()
}

fn index_tensor(values: &[usize], device: Device) -> Tensor {
    let values: Vec<i64> = values.iter().map(|&value| value as i64).collect();
    Tensor::from_slice(&values).to_device(device)
}

/// Of each simple space: zeros where it contains them, else its lower bounds (upstream's `PreviousAction`; where such a
/// bound is infinite, the upper one, or 0 if that is smaller).
fn null_action(action: &Space) -> Slab {
    fn append(space: &Space, real: &mut Vec<f32>) {
        match space {
            Space::Discrete(_) | Space::MultiDiscrete(_) => {}
            Space::Tuple(parts) => parts.iter().for_each(|part| append(part, real)),
            Space::Box { low, high } => {
                let bounds = || low.iter().zip(high);
                let zero_allowed = bounds().all(|(&low, &high)| (low..=high).contains(&0.0));
                let null = |(&low, &high): (&f32, &f32)| if low.is_finite() { low } else { high.min(0.0) };
                real.extend(bounds().map(|bounds| if zero_allowed { 0.0 } else { null(bounds) }));
            }
        }
    }
    let mut null = Slab::new(action, 1);
    null.real.clear();
    append(action, &mut null.real);
    null
}

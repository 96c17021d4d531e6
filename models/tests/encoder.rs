//! Input vectors against the reference, section 2 and table 1.1.

mod common;

use common::{FLOAT, assert_same_bits};
use popgym_envs::{Purpose, Registry, Slab, Space, Value, VecEnv, stream};
use popgym_models::Encoder;
use tch::{Device, Kind, Tensor};

fn encoder(id: &str) -> (Encoder, Space, Space) {
    let envs = VecEnv::new(&Registry::standard(), id, 1).unwrap();
    let (observation, action) = (envs.spec().observation.clone(), envs.spec().action.clone());
    (Encoder::new(&observation, &action, Device::Cpu), observation, action)
}

fn encode(encoder: &Encoder, observation: Value<'_>, action: Value<'_>, first: bool) -> Vec<f32> {
    let mut out = vec![f32::NAN; encoder.width()];
    encoder.encode(observation, action, first, &mut out);
    out
}

fn one_hot(width: usize, places: &[usize]) -> Vec<f32> {
    (0..width).map(|place| f32::from(places.contains(&place))).collect()
}

#[test]
fn widths_are_the_references() {
    let table = [
        ("RepeatPreviousEasy", 10),
        ("RepeatFirstHard", 10),
        ("StatelessCartPoleEasy", 6),
        ("StatelessPendulumMedium", 5),
        ("BattleshipEasy", 20),
        ("BattleshipMedium", 24),
        ("BattleshipHard", 28),
    ];
    for (id, width) in table {
        assert_eq!(encoder(id).0.width(), width, "{id}");
    }
}

#[test]
fn battleship_stands_as_hit_row_column_flag() {
    let (encoder, ..) = encoder("BattleshipEasy");
    let (hit, target) = (Value { discrete: &[1], real: &[] }, Value { discrete: &[3, 7], real: &[] });
    assert_eq!(encode(&encoder, hit, target, false), one_hot(20, &[1, 2 + 3, 10 + 7, 18]));
    // At a reset the previous action is row 0, column 0, whatever is given.
    let miss = Value { discrete: &[0], real: &[] };
    assert_eq!(encode(&encoder, miss, target, true), one_hot(20, &[0, 2, 10, 19]));
}

#[test]
fn control_keeps_its_numbers_raw() {
    let (pendulum, ..) = encoder("StatelessPendulumEasy");
    let (angle, torque) = (Value { discrete: &[], real: &[0.6, -0.8] }, Value { discrete: &[], real: &[-1.75] });
    assert_eq!(encode(&pendulum, angle, torque, false), [0.6, -0.8, -1.75, 1.0, 0.0]);
    assert_eq!(encode(&pendulum, angle, torque, true), [0.6, -0.8, 0.0, 0.0, 1.0]);
    let (cart, ..) = encoder("StatelessCartPoleEasy");
    let push = Value { discrete: &[1], real: &[] };
    assert_eq!(encode(&cart, angle, push, false), [0.6, -0.8, 0.0, 1.0, 1.0, 0.0]);
    assert_eq!(encode(&cart, angle, push, true), [0.6, -0.8, 1.0, 0.0, 0.0, 1.0]);
}

#[test]
fn the_null_action_is_zero_where_allowed_else_the_lower_bounds() {
    let boxed = |low: &[f32], high: &[f32]| Space::Box { low: low.to_vec(), high: high.to_vec() };
    let action = Space::Tuple(vec![boxed(&[-1.0, 1.0], &[1.0, 2.0]), Space::Discrete(2), boxed(&[-3.0], &[0.0])]);
    let encoder = Encoder::new(&Space::Discrete(1), &action, Device::Cpu);
    let given = Value { discrete: &[1], real: &[0.5, 1.5, -2.0] };
    let reset = encode(&encoder, Value { discrete: &[0], real: &[] }, given, true);
    // The first box does not contain the zero vector: its lower bounds, all of them.
    assert_eq!(reset, [1.0, -1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0]);
    let later = encode(&encoder, Value { discrete: &[0], real: &[] }, given, false);
    assert_eq!(later, [1.0, 0.5, 1.5, 0.0, 1.0, -2.0, 1.0, 0.0]);
}

#[test]
fn features_of_a_batch_equal_the_vectors_one_by_one() {
    let mixed = Space::Tuple(vec![
        Space::MultiDiscrete(vec![3, 256]),
        Space::uniform_box(2, -1.0, 1.0),
        Space::Discrete(2),
        Space::uniform_box(1, 1.0, 2.0),
    ]);
    let mut cases = vec![(Encoder::new(&mixed, &mixed, Device::Cpu), mixed.clone(), mixed)];
    cases.extend(["BattleshipHard", "StatelessPendulumEasy", "StatelessCartPoleEasy"].map(encoder));
    for (encoder, observation, action) in cases {
        let mut rng = stream(1, 2, 3, Purpose::EvalEnv);
        let (mut discrete, mut real, mut expected) = (Vec::new(), Vec::new(), Vec::new());
        for row in 0..50 {
            let (mut o, mut a) = (Slab::new(&observation, 1), Slab::new(&action, 1));
            observation.sample_into(&mut rng, o.row_mut(0));
            action.sample_into(&mut rng, a.row_mut(0));
            encoder.append_row(o.row(0), a.row(0), row % 7 == 0, &mut discrete, &mut real);
            expected.extend(encode(&encoder, o.row(0), a.row(0), row % 7 == 0));
        }
        let shape = |width: usize| [50, width as i64];
        let discrete = Tensor::from_slice(&discrete).view(shape(encoder.discrete_width()));
        let real = if real.is_empty() { Tensor::zeros([50, 0], FLOAT) } else { Tensor::from_slice(&real) };
        let features = encoder.features(&discrete, &real.view(shape(encoder.real_width())));
        assert_eq!(features.kind(), Kind::Float);
        assert_same_bits(&features, &Tensor::from_slice(&expected).view(shape(encoder.width())), "features");
    }
}

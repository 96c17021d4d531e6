//! The rules of the cart-poles and pendulums, one small story each.
#![allow(clippy::float_cmp, reason = "rewards and recorded numbers are compared to the last bit")]

mod common;

use std::f64::consts::{FRAC_PI_2, PI};

use common::{Episode, discrete, play, play_drawn};
use popgym_envs::cart_pole::{self, PositionOnlyCartPole};
use popgym_envs::noisy_cart_pole::{self, NoisyPositionOnlyCartPole};
use popgym_envs::noisy_pendulum::{self, NoisyPositionOnlyPendulum};
use popgym_envs::pendulum::{self, PositionOnlyPendulum};
use popgym_envs::velocity_only_cart_pole::{self, VelocityOnlyCartPole};
use popgym_envs::{Canvas, Env, Recorded, Registry, Slab, Step, View};
use serde_json::json;

fn assert_near(found: f64, expected: f64) {
    assert!((found - expected).abs() < 1e-9, "{found} is not {expected}");
}

/// The three cart-poles, of the given length; the noise of one of them is slight.
fn cart_poles(max_steps: u32) -> [Box<dyn Env>; 3] {
    [
        Box::new(PositionOnlyCartPole::new("game", cart_pole::Params { max_steps })),
        Box::new(VelocityOnlyCartPole::new("game", velocity_only_cart_pole::Params { max_steps })),
        Box::new(NoisyPositionOnlyCartPole::new("game", noisy_cart_pole::Params { max_steps, sigma: 1e-4 })),
    ]
}

/// Plays from `state`, with draws of zero, always pushing one way.
fn push(env: &mut dyn Env, state: [f64; 4], action: u8) -> Episode {
    env.set_world(&json!({ "state": state })).unwrap();
    play(env, &mut Recorded::new([0.0; 2000]), |_, _, out| out.set(0, discrete(&[action])))
}

#[test]
fn levels_differ_in_length_or_in_noise() {
    assert_eq!(cart_pole::LEVELS.map(|level| level.max_steps), [200, 400, 600]);
    assert_eq!(velocity_only_cart_pole::LEVELS.map(|level| level.max_steps), [200, 400, 600]);
    assert_eq!(pendulum::LEVELS.map(|level| level.max_steps), [200, 150, 100]);
    assert_eq!(
        noisy_cart_pole::LEVELS.map(|level| (level.max_steps, level.sigma)),
        [(200, 0.1), (200, 0.2), (200, 0.3)]
    );
    assert_eq!(
        noisy_pendulum::LEVELS.map(|level| (level.max_steps, level.sigma)),
        [(200, 0.1), (200, 0.2), (200, 0.3)]
    );
}

#[test]
fn cart_pole_pays_for_standing() {
    for level in cart_pole::LEVELS {
        let mut env = PositionOnlyCartPole::new("game", level);
        // Velocities are differences of the last two observations.
        let episode = play_drawn(&mut env, 0, 2, |t, seen, action| {
            let (now, before) = (seen.row(t).real, seen.row(t.saturating_sub(1)).real);
            let lean =
                0.3 * now[0] + 0.7 * (now[0] - before[0]) / 0.02 + 10.0 * now[1] + 2.0 * (now[1] - before[1]) / 0.02;
            action.discrete[0] = u8::from(lean > 0.0);
        });
        assert_eq!(episode.steps.len(), level.max_steps as usize);
        assert_near(episode.total(), 1.0);
        let last = episode.steps.last().unwrap();
        assert!(last.truncated && !last.terminated);
    }
}

/// Pushing one way makes the pole fall; the falling step is paid too, and can be the last step allowed.
#[test]
fn cart_pole_falls() {
    let right = |_: usize, _: &Slab, action: &mut Slab| action.discrete[0] = 1;
    for game in 0..3 {
        let play = |max_steps| play_drawn(cart_poles(max_steps)[game].as_mut(), 0, 3, right);
        let long = play(200);
        let steps = long.steps.len() as u32;
        assert!((8..=12).contains(&steps), "{steps}");
        assert_eq!(*long.steps.last().unwrap(), Step { reward: 0.005, terminated: true, truncated: false });
        assert_near(long.total(), f64::from(steps) / 200.0);
        let short = play(steps);
        assert_eq!(short.observations, long.observations);
        assert!(short.steps.last().unwrap().terminated && short.steps.last().unwrap().truncated);
    }
}

/// From rest, worked out by hand: a push of 10 N on 1.1 kg turns the pole by 10/1.1 / (0.5 (4/3 - 0.1/1.1)) rad/s^2.
#[test]
fn cart_pole_accelerates_as_it_should() {
    let push_acc = 10.0 / 1.1;
    let theta_acc = -push_acc / (0.5 * (4.0 / 3.0 - 0.1 / 1.1));
    let x_acc = push_acc - 0.05 * theta_acc / 1.1;
    for env in &mut cart_poles(200) {
        for (action, sign) in [(0, -1.0), (1, 1.0)] {
            let episode = push(env.as_mut(), [0.0; 4], action);
            let expected = [0.0, 0.02 * sign * x_acc, 0.0, 0.02 * sign * theta_acc].map(|part| part as f32);
            let found = episode.states.row(1).real;
            assert!(found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{found:?} is not {expected:?}");
        }
    }
}

#[test]
fn left_and_right_are_mirror_images() {
    let state = [0.03, -0.02, 0.04, 0.01];
    for env in &mut cart_poles(200) {
        let right = push(env.as_mut(), state, 1);
        let left = push(env.as_mut(), state.map(|part| -part), 0);
        assert_eq!(left.steps, right.steps);
        assert!(left.states.real.iter().zip(&right.states.real).all(|(a, b)| *a == -b));
        assert!(left.observations.real.iter().zip(&right.observations.real).all(|(a, b)| *a == -b));
    }
}

/// The limits themselves, 2.4 m and 12 degrees, are still within.
#[test]
fn cart_pole_ends_beyond_its_limits() {
    let limit = 12.0 * 2.0 * PI / 360.0;
    for env in &mut cart_poles(200) {
        for (state, falls) in [
            ([2.4, 0.0, 0.0, 0.0], false),
            ([-2.4, 0.0, 0.0, 0.0], false),
            ([2.39, 1.0, 0.0, 0.0], true),
            ([-2.39, -1.0, 0.0, 0.0], true),
            ([0.0, 0.0, limit, 0.0], false),
            ([0.0, 0.0, -limit, 0.0], false),
            ([0.0, 0.0, 0.209, 0.1], true),
            ([0.0, 0.0, -0.209, -0.1], true),
        ] {
            assert_eq!(push(env.as_mut(), state, 1).steps[0].terminated, falls, "{state:?}");
        }
    }
}

#[test]
fn velocities_are_shown_after_the_first_observation() {
    let [mut positions, mut velocities, _] = cart_poles(200);
    let act = |t: usize, _: &Slab, action: &mut Slab| action.discrete[0] = u8::from(t.is_multiple_of(3));
    let positions = play_drawn(positions.as_mut(), 0, 4, act);
    let velocities = play_drawn(velocities.as_mut(), 0, 4, act);
    assert_eq!((&positions.states, &positions.steps), (&velocities.states, &velocities.steps));
    for t in 0..=positions.steps.len() {
        let state = positions.states.row(t).real;
        assert_eq!(positions.observations.row(t).real, [state[0], state[2]]);
        let shown = if t == 0 { [state[0], state[2]] } else { [state[1], state[3]] };
        assert_eq!(velocities.observations.row(t).real, shown);
    }
}

/// A noisy game is the clean one: the same world from the same stream, the same steps and states; only what is shown
/// differs.
#[test]
fn noise_is_on_the_observations_alone() {
    let sigma = 0.1;
    let games: [[Box<dyn Env>; 2]; 2] = [
        [
            Box::new(PositionOnlyCartPole::new("game", cart_pole::LEVELS[0])),
            Box::new(NoisyPositionOnlyCartPole::new("game", noisy_cart_pole::Params { max_steps: 200, sigma })),
        ],
        [
            Box::new(PositionOnlyPendulum::new("game", pendulum::LEVELS[0])),
            Box::new(NoisyPositionOnlyPendulum::new("game", noisy_pendulum::Params { max_steps: 200, sigma })),
        ],
    ];
    for game in games {
        let [clean, noisy] = game.map(|mut env| {
            play_drawn(env.as_mut(), 0, 5, |t, _, action| {
                action.discrete.fill(u8::from(t.is_multiple_of(3)));
                action.real.fill(if t % 40 < 20 { -2.0 } else { 2.0 });
            })
        });
        assert_eq!((&clean.states, &clean.steps), (&noisy.states, &noisy.steps));
        for (a, b) in clean.observations.real.iter().zip(&noisy.observations.real) {
            assert!(a != b && (a - b).abs() < 5.0 * sigma as f32, "{a} {b}");
        }
    }
}

/// Recorded noise is added as it is, in pairs, one pair an observation, and clipped with the observation.
#[test]
fn recorded_noise_is_added_and_clipped() {
    let noise = [0.25, -0.5, -100.0, 100.0, 100.0, -100.0, 0.0, 0.0];
    let mut cart = NoisyPositionOnlyCartPole::new("game", noisy_cart_pole::Params { max_steps: 3, sigma: 0.3 });
    cart.set_world(&json!({ "state": [0.5, 0.0, 0.125, 0.0] })).unwrap();
    let episode = play(&mut cart, &mut Recorded::new(noise), |_, _, _| {});
    let (x, theta) = (4.8, 24.0_f32.to_radians());
    assert_eq!(episode.observations.row(0).real, [0.75, -0.375]);
    assert_eq!(episode.observations.row(1).real, [-x, theta]);
    assert_eq!(episode.observations.row(2).real, [x, -theta]);
    let last = episode.states.row(3).real;
    assert_eq!(episode.observations.row(3).real, [last[0], last[2]]);

    let mut rod = NoisyPositionOnlyPendulum::new("game", noisy_pendulum::Params { max_steps: 3, sigma: 0.3 });
    rod.set_world(&json!({ "theta": 0.0, "theta_dot": 0.0 })).unwrap();
    let noise = [-0.25, 0.5, 0.25, -100.0, -100.0, 100.0, 0.0, 0.0];
    let episode = play(&mut rod, &mut Recorded::new(noise), |_, _, _| {});
    assert_eq!(episode.observations.real, [0.75, 0.5, 1.0, -1.0, -1.0, 1.0, 1.0, 0.0]);
}

/// The two pendulums, of the given length; one without noise.
fn pendulums(max_steps: u32) -> [Box<dyn Env>; 2] {
    [
        Box::new(PositionOnlyPendulum::new("game", pendulum::Params { max_steps })),
        Box::new(NoisyPositionOnlyPendulum::new("game", noisy_pendulum::Params { max_steps, sigma: 0.3 })),
    ]
}

/// Plays from this angle and velocity, with draws of zero, always with the same torque.
fn swing(env: &mut dyn Env, theta: f64, theta_dot: f64, torque: f32) -> Episode {
    env.set_world(&json!({ "theta": theta, "theta_dot": theta_dot })).unwrap();
    play(env, &mut Recorded::new([0.0; 1000]), |_, _, action| action.real[0] = torque)
}

#[test]
fn pendulum_pays_between_the_bounds() {
    for max_steps in [200, 150, 100] {
        for env in &mut pendulums(max_steps) {
            let upright = swing(env.as_mut(), 0.0, 0.0, 0.0);
            assert_eq!(upright.steps.len(), max_steps as usize);
            assert_near(upright.total(), 1.0);
            let last = upright.steps.last().unwrap();
            assert!(last.truncated && !last.terminated);

            // Hanging, at full speed, with full torque; a larger torque is clipped.
            let [full, beyond] = [2.0, 7.0].map(|torque| swing(env.as_mut(), PI, 8.0, torque));
            assert!((full.steps[0].reward + 1.0 / f64::from(max_steps)).abs() < 1e-9);
            assert_eq!(full.steps, beyond.steps);
            assert_eq!(full.observations, beyond.observations);
        }
    }
}

/// From rest on the level: gravity turns by 15 rad/s^2, each N m of torque by 3; the new velocity turns the rod, the
/// cost is that of the old state.
#[test]
fn pendulum_accelerates_as_it_should() {
    for env in &mut pendulums(100) {
        for torque in [-2.0_f32, 0.0, 1.0] {
            let episode = swing(env.as_mut(), FRAC_PI_2, 0.0, torque);
            let speed = (15.0 + 3.0 * f64::from(torque)) * 0.05;
            let angle = FRAC_PI_2 + speed * 0.05;
            let expected = [angle.cos(), angle.sin(), speed].map(|part| part as f32);
            let found = episode.states.row(1).real;
            assert!(found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{found:?} is not {expected:?}");
            let cost = FRAC_PI_2.powi(2) + 0.001 * f64::from(torque).powi(2);
            assert_near(episode.steps[0].reward, (1.0 - cost / 8.136_802_2) / 100.0);
        }
    }
}

/// Neither the speed nor the number of turns goes beyond what the reward is made for.
#[test]
fn pendulum_speed_is_limited() {
    for env in &mut pendulums(200) {
        let episode = swing(env.as_mut(), 0.1, 8.0, 2.0);
        let speeds: Vec<f32> = (0..=200).map(|t| episode.states.row(t).real[2]).collect();
        assert!(speeds.iter().all(|speed| (0.0..=8.0).contains(speed)));
        assert!(speeds.iter().filter(|&&speed| speed == 8.0).count() > 10);
        // Some turns later the cost is that of the angle from upright, not of all the turns.
        assert!(episode.steps.iter().all(|step| step.reward.abs() <= 1.0 / 200.0 + 1e-9));
    }
}

#[test]
fn bad_worlds_are_errors() {
    let mut cases = Vec::new();
    for cart in ["StatelessCartPoleEasy", "VelocityOnlyCartPoleHard", "NoisyStatelessCartPoleMedium"] {
        cases.extend([
            (cart, json!({ "state": [0.0, 0.0, 0.0] }), "length 3"),
            (cart, json!({ "state": [0.0, null, 0.0, 0.0] }), "null"),
            (cart, json!({ "state": [2.5, 0.0, 0.0, 0.0] }), "position is 2.5, allowed is -2.4..=2.4"),
            (cart, json!({ "state": [0.0, 101.0, 0.0, 0.0] }), "velocity is 101"),
            (cart, json!({ "state": [0.0, 0.0, -0.21, 0.0] }), "angle is -0.21"),
            (cart, json!({ "state": [0.0, 0.0, 0.0, -1e300] }), "angular velocity is -1"),
            (cart, json!({ "state": [0.0, 0.0, 0.0, 0.0], "observation_noise": [] }), "unknown field"),
        ]);
    }
    for rod in ["StatelessPendulumEasy", "NoisyStatelessPendulumHard"] {
        cases.extend([
            (rod, json!({ "theta": 0.0, "theta_dot": 9.0 }), "theta_dot is 9"),
            (rod, json!({ "theta": 0.0 }), "theta_dot"),
        ]);
    }
    let registry = Registry::standard();
    for (name, world, reason) in cases {
        let mut env = registry.make(name).unwrap();
        let before = env.world();
        let error = env.set_world(&world).expect_err(name);
        assert!(error.contains(reason), "{name}: {error}");
        assert_eq!(env.world(), before);
    }
}

/// However fast a given cart-pole is, its last observation and state are points of their spaces, which `play` checks.
#[test]
fn the_fastest_worlds_stay_in_their_spaces() {
    let largest = [2.4, 100.0, 0.2094, 8.0];
    for name in ["StatelessCartPoleEasy", "VelocityOnlyCartPoleEasy"] {
        let mut env = Registry::standard().make(name).unwrap();
        // Each number at its lower limit, half of it, nothing, and the same upwards.
        for case in 0..5_usize.pow(4) {
            let state = [0, 1, 2, 3].map(|i| largest[i] * 0.5 * ((case / 5_usize.pow(i as u32) % 5) as f64 - 2.0));
            for action in [0, 1] {
                assert!(push(env.as_mut(), state, action).steps.last().unwrap().terminated, "{state:?}");
            }
        }
    }
}

#[test]
fn noise_that_makes_no_sense_is_refused() {
    for sigma in [-0.1, f64::NAN, f64::INFINITY] {
        let max_steps = 1;
        let cart = move || drop(NoisyPositionOnlyCartPole::new("game", noisy_cart_pole::Params { max_steps, sigma }));
        let rod = move || drop(NoisyPositionOnlyPendulum::new("game", noisy_pendulum::Params { max_steps, sigma }));
        assert!(std::panic::catch_unwind(cart).is_err() && std::panic::catch_unwind(rod).is_err(), "{sigma}");
    }
}

fn picture(env: &dyn Env, view: View) -> String {
    let mut canvas = Canvas::new();
    env.render(view, &mut canvas);
    canvas.to_text()
}

/// What the agent does not see is not in its picture.
#[test]
fn pictures_show_what_is_seen() {
    let begin = |env: &mut dyn Env, world: serde_json::Value, noise: [f64; 2]| {
        env.set_world(&world).unwrap();
        let mut observation = Slab::new(&env.spec().observation, 1);
        env.begin(&mut Recorded::new(noise), observation.row_mut(0));
    };
    let [mut positions, mut velocities, mut noisy] = cart_poles(200);
    for env in [&mut positions, &mut velocities, &mut noisy] {
        assert_eq!(env.action_names(), ["left", "right"]);
        let [slow, fast] = [0.0, 0.7].map(|speed| {
            begin(env.as_mut(), json!({ "state": [0.25, speed, 0.125, -speed] }), [0.0; 2]);
            [View::Observed, View::Revealed].map(|view| picture(env.as_ref(), view))
        });
        assert_eq!(slow[0], fast[0]);
        assert_ne!(slow[1], fast[1]);
        assert!(slow[0].contains("position +0.250 m   angle +7.16 deg"), "{}", slow[0]);
        assert!(fast[1].contains("velocity +0.700 m/s   angular velocity -40.11 deg/s"), "{}", fast[1]);
    }

    // The cart of the noisy game is drawn where it is seen.
    begin(noisy.as_mut(), json!({ "state": [0.0, 0.0, 0.0, 0.0] }), [1.0, 0.1]);
    assert!(picture(noisy.as_ref(), View::Observed).contains("position +1.000 m   angle +5.73 deg"));
    assert!(picture(noisy.as_ref(), View::Revealed).contains("position +0.000 m   angle +0.00 deg"));

    // From its first step on, the other one shows velocities and no position.
    let mut observation = Slab::new(&velocities.spec().observation, 1);
    velocities.step(discrete(&[1]), &mut Recorded::default(), observation.row_mut(0));
    let seen = picture(velocities.as_ref(), View::Observed);
    let expected = format!("{:+.3} m/s", observation.real[0]);
    assert!(seen.contains(&expected) && !seen.contains("position"), "{seen}");

    let [mut rod, mut noisy_rod] = pendulums(100);
    for env in [&mut rod, &mut noisy_rod] {
        begin(env.as_mut(), json!({ "theta": FRAC_PI_2, "theta_dot": 1.0 }), [-0.5, 0.0]);
    }
    let [seen, noisy_seen] = [&rod, &noisy_rod].map(|env| picture(env.as_ref(), View::Observed));
    assert!(seen.contains("cosine +0.000   sine +1.000") && !seen.contains("velocity"), "{seen}");
    // A positive angle leans to the left.
    assert!(seen.contains("●───") && !seen.contains("───●"), "{seen}");
    assert!(noisy_seen.contains("cosine -0.500   sine +1.000"), "{noisy_seen}");
    let revealed = picture(noisy_rod.as_ref(), View::Revealed);
    assert!(revealed.contains("cosine +0.000   sine +1.000") && revealed.contains("+57.30 deg/s"), "{revealed}");
    let (mut observation, mut action) = (Slab::new(&rod.spec().observation, 1), Slab::new(&rod.spec().action, 1));
    action.real[0] = -1.5;
    rod.step(action.row(0), &mut Recorded::default(), observation.row_mut(0));
    assert!(picture(rod.as_ref(), View::Observed).contains("-1.500 N m"));
}

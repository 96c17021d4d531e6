//! The rules of the card games and of the bandits, one small story each.

#![allow(clippy::float_cmp, reason = "rewards and recorded numbers are compared to the last bit")]

mod common;

use common::{Episode, play, play_drawn};
use popgym_envs::autoencode::{self, Autoencode};
use popgym_envs::concentration::{self, Concentration};
use popgym_envs::count_recall::{self, CountRecall};
use popgym_envs::deck::Field;
use popgym_envs::higher_lower::{self, HigherLower};
use popgym_envs::multiarmed_bandit::{self, MultiarmedBandit};
use popgym_envs::repeat_first::{self, RepeatFirst};
use popgym_envs::repeat_previous::{self, RepeatPrevious};
use popgym_envs::{Env, Purpose, Recorded, Registry, Step, stream};
use serde_json::{Value as Json, json};

fn assert_near(found: f64, expected: f64) {
    assert!((found - expected).abs() < 1e-9, "{found} is not {expected}");
}

/// Plays without per-step draws; action `t` is `act(t)`.
fn play_classes(env: &mut dyn Env, act: impl Fn(usize) -> u8) -> Episode {
    play(env, &mut Recorded::default(), |t, _, action| action.discrete[0] = act(t))
}

fn ended(last: &Step) -> (bool, bool) {
    (last.terminated, last.truncated)
}

/// The world's `deck`.
fn cards(env: &dyn Env) -> Vec<u16> {
    serde_json::from_value(env.world()["deck"].clone()).unwrap()
}

#[test]
fn repeat_previous_pays_for_the_card_k_ago() {
    let levels = repeat_previous::LEVELS.map(|level| (level.decks, level.k));
    for (decks, k) in levels.into_iter().chain([(1, 1), (1, 2), (1, 16), (1, 51)]) {
        let mut env = RepeatPrevious::new("game", repeat_previous::Params { decks, k });
        let n = 52 * decks;
        // `shift` 0 answers rightly, any other wrongly.
        for (shift, expected) in [(0, 1.0), (1, -1.0)] {
            let episode = play_drawn(&mut env, 0, 0, |t, seen, action| {
                let target = t.checked_sub(k - 1).map_or(0, |target| seen.row(target).discrete[0]);
                action.discrete[0] = (target + shift) % 4;
            });
            assert_eq!(episode.steps.len(), n - 1);
            assert_near(episode.total(), expected);
            assert!(episode.steps[..k - 1].iter().all(|step| step.reward == 0.0));
            assert!(episode.steps[k - 1..].iter().all(|step| step.reward == expected / (n - k) as f64));
            assert_eq!(*episode.steps.last().unwrap(), Step { terminated: true, ..episode.steps[n - 2] });
        }
    }
}

#[test]
fn repeat_first_pays_for_the_first_card() {
    for level in repeat_first::LEVELS {
        let mut env = RepeatFirst::new("game", level);
        for (shift, expected) in [(0, 1.0), (2, -1.0)] {
            let episode = play_drawn(&mut env, 0, 1, |_, seen, action| {
                action.discrete[0] = (seen.row(0).discrete[0] + shift) % 4;
            });
            assert_eq!(episode.steps.len(), 52 * level.decks - 1);
            assert_near(episode.total(), expected);
            assert!(episode.steps.last().unwrap().terminated);
        }
    }
}

/// Cards are shown from the end of the array, and all of them are shown.
#[test]
fn cards_come_from_the_end_of_the_deck() {
    let deck: Vec<u16> = (0..52).map(|i| (i * 5 + 3) % 52).collect();
    let suits: Vec<u8> = deck.iter().rev().map(|card| (card % 4) as u8).collect();
    let [first, previous] = [repeat_first::LEVELS[0].decks, repeat_previous::LEVELS[0].decks];
    assert_eq!((first, previous), (1, 1));
    let games: [Box<dyn Env>; 2] = [
        Box::new(RepeatFirst::new("game", repeat_first::LEVELS[0])),
        Box::new(RepeatPrevious::new("game", repeat_previous::LEVELS[0])),
    ];
    for mut env in games {
        env.set_world(&json!({ "deck": deck })).unwrap();
        let episode = play(env.as_mut(), &mut Recorded::default(), |_, _, _| {});
        assert_eq!(episode.observations.discrete, suits);
        assert_eq!(episode.states.row(51).real, [0.0; 4], "no card is left");
    }
}

#[test]
fn autoencode_pays_for_the_suits_backwards() {
    for level in autoencode::LEVELS {
        let n = 52 * level.decks;
        let mut env = Autoencode::new("game", level);
        for (shift, expected) in [(0, 1.0), (3, -1.0)] {
            let episode = play_drawn(&mut env, 0, 2, |t, seen, action| {
                // The answer at time n - 1 + i is the suit seen at time n - 1 - i.
                let target = if t < n - 1 { t } else { 2 * (n - 1) - t };
                action.discrete[0] = (seen.row(target).discrete[1] + shift) % 4;
            });
            assert_eq!(episode.steps.len(), 2 * n - 1);
            assert_near(episode.total(), expected);
            assert!(episode.steps[..n - 1].iter().all(|step| *step == Step::default()), "watching is free");
            assert!(episode.steps[n - 1..].iter().all(|step| step.reward == expected / n as f64));
            assert!(episode.steps[..2 * n - 2].iter().all(|step| !step.done()));
            assert_eq!(ended(&episode.steps[2 * n - 2]), (true, false));
        }
    }
}

#[test]
fn autoencode_shows_the_last_card_in_the_mode_to_play() {
    let mut env = Autoencode::new("game", autoencode::LEVELS[0]);
    // The last card dealt, the first of the array, is a heart.
    let deck: Vec<u16> = (0..52).rev().collect();
    env.set_world(&json!({ "deck": deck })).unwrap();
    let episode = play_classes(&mut env, |t| [1, 3][usize::from(t == 51)]);
    let row = |t| episode.observations.row(t).discrete;
    assert_eq!([row(0), row(1), row(50)], [[1, 0], [1, 1], [1, 2]]);
    assert_eq!([row(51), row(52), row(103)], [[0, 3], [0, 0], [0, 0]]);
    assert_eq!(episode.steps[50].reward, 0.0, "the answer to the last card but one does not count");
    assert_eq!(episode.steps[51].reward, 1.0 / 52.0, "the answer to the last card counts");
    let hand = |t| episode.states.row(t).real[0];
    assert_eq!([hand(0), hand(50), hand(51), hand(52)], [1.0 / 52.0, 51.0 / 52.0, 1.0, 51.0 / 52.0]);
    assert_eq!(hand(103), 0.0, "no card is left in the hand");
}

#[test]
fn count_recall_pays_for_counts() {
    for (level, classes) in count_recall::LEVELS.into_iter().zip([2, 4, 13]) {
        let n = 52 * level.decks;
        let mut env = CountRecall::new("game", level);
        for (shift, expected) in [(0, 1.0), (1, -1.0)] {
            let episode = play_drawn(&mut env, 0, 3, |t, seen, action| {
                let query = seen.row(t).discrete[1];
                let count = (0..=t).filter(|&past| seen.row(past).discrete[0] == query).count();
                action.discrete[0] = (count + shift) as u8 % (n / classes + 1) as u8;
            });
            assert_eq!(episode.steps.len(), n - 1);
            assert!(episode.steps.iter().all(|step| step.reward == expected / (n - 1) as f64));
            assert_near(episode.total(), expected);
            assert_eq!(ended(episode.steps.last().unwrap()), (true, false));
        }
    }
}

/// All cards of the class that is asked for are shown first: the full count is the right answer from then on.
#[test]
fn count_recall_takes_the_full_count() {
    for (level, (classes, each)) in count_recall::LEVELS.into_iter().zip([(2, 26), (4, 26), (13, 16)]) {
        let mut env = CountRecall::new("game", level);
        let class = |card: u16| match classes {
            2 => card % 2,
            4 => card % 4,
            _ => card % 52 / 4,
        };
        // Dealt from the end: class 1 first, and asked for while it lasts.
        let mut deck: Vec<u16> = (0..52 * level.decks as u16).collect();
        deck.sort_by_key(|&card| class(card) == 1);
        env.set_world(&json!({ "value_deck": deck, "query_deck": deck })).unwrap();
        let episode = play_classes(&mut env, |t| (t + 1).min(each) as u8);
        let unit = 1.0 / (52 * level.decks - 1) as f64;
        assert_eq!(episode.states.row(each - 1).real[1], 1.0);
        assert!(episode.steps[..each].iter().all(|step| step.reward == unit), "counts from 1 to {each}");
        assert_eq!(episode.steps[each].reward, -unit, "the next query asks for another class, of which one was shown");
    }
}

#[test]
fn higher_lower_pays_for_rises() {
    for level in higher_lower::LEVELS {
        let n = 52 * level.decks;
        let mut env = HigherLower::new("game", level);
        for (guess, sign) in [(0, 1), (1, -1)] {
            let episode = play_drawn(&mut env, 0, 4, |_, _, action| action.discrete[0] = guess);
            let ranks: Vec<i32> = cards(&env).iter().rev().map(|card| i32::from(card % 52 / 4)).collect();
            let signs: i32 = ranks.windows(2).map(|pair| (pair[1] - pair[0]).signum()).sum();
            assert_eq!(episode.steps.len(), n - 1);
            assert_near(episode.total(), f64::from(sign * signs) / n as f64);
            assert_eq!(ended(episode.steps.last().unwrap()), (true, false));
        }
    }
    // Kings first, aces last: of each rank three equal cards follow, which pay nothing.
    let mut env = HigherLower::new("game", higher_lower::LEVELS[0]);
    env.set_world(&json!({ "deck": (0..52).collect::<Vec<u16>>() })).unwrap();
    for (guess, unit) in [(0, -1.0 / 52.0), (1, 1.0 / 52.0)] {
        let episode = play_classes(&mut env, |_| guess);
        for (t, step) in episode.steps.iter().enumerate() {
            assert_eq!(step.reward, if t % 4 == 3 { unit } else { 0.0 });
        }
    }
}

/// To say higher below the middle rank, and lower else, returns 336/676 on average, whatever the number of decks.
#[test]
fn higher_lower_without_memory_returns_what_it_should() {
    const EPISODES: u64 = 3000;
    for level in higher_lower::LEVELS {
        let mut env = HigherLower::new("game", level);
        let returns: Vec<f64> = (0..EPISODES)
            .map(|index| {
                let act = |t, seen: &popgym_envs::Slab, action: &mut popgym_envs::Slab| {
                    action.discrete[0] = u8::from(seen.row(t).discrete[0] >= 6);
                };
                play_drawn(&mut env, 5, index, act).total()
            })
            .collect();
        let (mean, error) = mean_and_error(&returns);
        assert!((mean - 336.0 / 676.0).abs() < 4.0 * error, "{mean} +- {error}");
    }
}

fn mean_and_error(values: &[f64]) -> (f64, f64) {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    (mean, values.iter().map(|x| (x - mean).powi(2)).sum::<f64>().sqrt() / n)
}

/// A drawn table, its classes, and its places class by class: flipping these in order is a perfect game.
fn table(level: concentration::Params, index: u64) -> (Concentration, Vec<u16>, Vec<u8>) {
    let mut env = Concentration::new("game", level);
    env.draw_world(&mut stream(0, 0, index, Purpose::TrainEnv));
    let class = |card: u16| if level.field == Field::Rank { card % 52 / 4 } else { card % 2 };
    let classes: Vec<u16> = cards(&env).into_iter().map(class).collect();
    let mut places: Vec<u8> = (0..classes.len() as u8).collect();
    places.sort_by_key(|&place| classes[usize::from(place)]);
    (env, classes, places)
}

/// Cards on the table, most steps, classes.
const TABLES: [(usize, usize, u8); 3] = [(52, 104, 2), (104, 208, 2), (52, 104, 13)];

#[test]
fn concentration_played_perfectly() {
    for (level, (n, most, down)) in concentration::LEVELS.into_iter().zip(TABLES) {
        let (mut env, classes, places) = table(level, 0);
        let episode = play_classes(&mut env, |t| places[t]);
        assert_eq!((episode.steps.len(), env.spec().max_steps as usize), (n, most));
        assert_near(episode.total(), 1.0);
        for (t, step) in episode.steps.iter().enumerate() {
            assert_eq!(step.reward, if t % 2 == 0 { 0.0 } else { 2.0 / n as f64 });
            assert_eq!(ended(step), (t == n - 1, false));
        }
        for t in 0..=n {
            let seen = episode.observations.row(t).discrete;
            for place in 0..n {
                let up = places[..t].contains(&(place as u8));
                assert_eq!(u16::from(seen[place]), if up { classes[place] } else { u16::from(down) });
            }
        }

        // First everything wrong for half of the time: the last pair comes with the last step.
        let late = play_classes(&mut env, |t| if t < most - n { 0 } else { places[t - (most - n)] });
        assert_eq!(late.steps.len(), most);
        assert_eq!(ended(&late.steps[most - 1]), (true, true));
        assert_near(late.total(), 1.0 - (most - n) as f64 / most as f64);
    }
}

#[test]
fn concentration_played_wrongly() {
    for (level, (n, most, _)) in concentration::LEVELS.into_iter().zip(TABLES) {
        let (mut env, _, places) = table(level, 1);
        let fail = -1.0 / most as f64;
        let same = play_classes(&mut env, |_| 0);
        assert_near(same.total(), -1.0);
        assert!(same.steps.iter().enumerate().all(|(t, step)| step.reward == [0.0, 2.0 * fail][t % 2]));
        assert_eq!(same.steps.len(), most);
        assert_eq!(ended(&same.steps[most - 1]), (false, true));
        assert!(same.steps[..most - 1].iter().all(|step| !step.done()));

        // A pair, and then only its two cards.
        let matched = play_classes(&mut env, |t| places[t % 2]);
        assert_near(matched.total(), 2.0 / n as f64 + (most - 2) as f64 * fail);
        assert!(matched.steps[2..].iter().all(|step| step.reward == fail));
        assert_eq!(ended(&matched.steps[most - 1]), (false, true));
    }
}

#[test]
fn concentration_step_by_step() {
    for (level, (n, most, down)) in concentration::LEVELS.into_iter().zip(TABLES) {
        let (mut env, classes, places) = table(level, 2);
        let (fail, pair) = (-1.0 / most as f64, 2.0 / n as f64);
        // Two that match, one more of their class, and two of the last class.
        let [a, b, c, y, z] = [places[0], places[1], places[2], places[n - 2], places[n - 1]];
        let flips = [a, b, c, y, y, c, a, z, y, a, c, c];
        let episode = play_classes(&mut env, |t| flips.get(t).copied().unwrap_or(0));
        let rewards: Vec<f64> = episode.steps[..flips.len()].iter().map(|step| step.reward).collect();
        // a b match; c y do not; y c do not; a as the first is lost; z y match; a is lost; c twice is no pair.
        let expected = [0.0, pair, 0.0, 2.0 * fail, 0.0, 2.0 * fail, fail, 0.0, pair, fail, 0.0, 2.0 * fail];
        assert_eq!(rewards, expected);

        let up = |t: usize| -> Vec<u8> {
            let seen = episode.observations.row(t).discrete;
            let mut up: Vec<u8> = (0..n as u8).filter(|&place| seen[usize::from(place)] != down).collect();
            assert!(up.iter().all(|&place| u16::from(seen[usize::from(place)]) == classes[usize::from(place)]));
            up.sort_unstable();
            up
        };
        let sorted = |places: &[u8]| {
            let mut places = places.to_vec();
            places.sort_unstable();
            places
        };
        let shown: [&[u8]; 13] = [
            &[],
            &[a],
            &[a, b],
            &[a, b, c],
            &[a, b, c, y],
            &[a, b, y],
            &[a, b, y, c],
            &[a, b],
            &[a, b, z],
            &[a, b, z, y],
            &[a, b, z, y],
            &[a, b, z, y, c],
            &[a, b, z, y, c],
        ];
        let turned = [[down; 2], [a, down], [a, b], [c, down], [c, y], [y, down], [y, c], [a, down]];
        for (t, places) in shown.into_iter().enumerate() {
            assert_eq!(up(t), sorted(places), "at time {t}");
            let state = episode.states.row(t).discrete;
            assert!(state[..n].iter().zip(&classes).all(|(&found, &class)| u16::from(found) == class));
            if let Some(turned) = turned.get(t) {
                assert_eq!(state[2 * n..], *turned, "at time {t}");
            }
        }
        let matched: Vec<u8> =
            (0..n as u8).filter(|&i| episode.states.row(12).discrete[n + usize::from(i)] == 1).collect();
        assert_eq!(matched, sorted(&[a, b, z, y]));
    }
}

/// To turn a matched card over as the second costs two units and takes the first card out of play as well.
#[test]
fn concentration_loses_the_first_card_with_a_matched_second() {
    for (level, (n, most, down)) in concentration::LEVELS.into_iter().zip(TABLES) {
        let (mut env, _, places) = table(level, 3);
        let [a, b, c, d] = [0, 1, 2, 3].map(|i| places[i]);
        let flips = [a, b, c, a, d, c];
        let episode = play_classes(&mut env, |t| flips.get(t).copied().unwrap_or(a));
        let rewards: Vec<f64> = episode.steps[..6].iter().map(|step| step.reward).collect();
        let pair = 2.0 / n as f64;
        assert_eq!(rewards, [0.0, pair, 0.0, -2.0 / most as f64, 0.0, pair], "d is a first card");
        assert_eq!(episode.observations.row(4).discrete.iter().filter(|&&seen| seen != down).count(), 3);
        assert_eq!(episode.observations.row(5).discrete[usize::from(c)], down);
    }
}

#[test]
fn bandits_pay_by_their_odds() {
    let mut env = MultiarmedBandit::new("game", multiarmed_bandit::Params { arms: 4, steps: 8 });
    env.set_world(&json!({ "payout_probability": [0.0, 0.25, 0.75, 1.0] })).unwrap();
    let draws = [0.0, 0.25, 0.249, 0.749, 0.75, 0.999, 0.25, 0.5];
    let arms = [0, 1, 1, 2, 2, 3, 2, 1];
    let paid = [0, 0, 1, 1, 0, 1, 1, 0];
    let episode = play(&mut env, &mut Recorded::new(draws), |t, _, action| action.discrete[0] = arms[t]);
    assert_eq!(episode.observations.discrete[0], 0);
    assert_eq!(episode.observations.discrete[1..], paid);
    for (t, step) in episode.steps.iter().enumerate() {
        assert_eq!(step.reward, if paid[t] == 1 { 0.125 } else { -0.125 });
        assert_eq!(ended(step), (false, t == 7));
    }
    assert!((0..=8).all(|t| episode.states.row(t).real == [0.0, 0.25, 0.75, 1.0]));
}

#[test]
fn the_best_arm_returns_twice_its_odds_less_one() {
    for (level, steps) in multiarmed_bandit::LEVELS.into_iter().zip([200, 400, 600]) {
        let mut env = MultiarmedBandit::new("game", level);
        let mut rng = stream(0, 1, 0, Purpose::EvalEnv);
        env.draw_world(&mut rng);
        let odds: Vec<f64> = serde_json::from_value(env.world()["payout_probability"].clone()).unwrap();
        let (best, &p) = odds.iter().enumerate().max_by(|a, b| a.1.total_cmp(b.1)).unwrap();
        let episode = play(&mut env, &mut rng, |_, _, action| action.discrete[0] = best as u8);
        assert_eq!(episode.steps.len(), steps);
        assert_eq!(ended(&episode.steps[steps - 1]), (false, true));
        let sigma = 2.0 * (p * (1.0 - p) / steps as f64).sqrt();
        assert!((episode.total() - (2.0 * p - 1.0)).abs() < 4.0 * sigma);
    }
}

const GAMES: [&str; 7] =
    ["Autoencode", "CountRecall", "RepeatFirst", "RepeatPrevious", "MultiarmedBandit", "Concentration", "HigherLower"];

#[test]
fn a_world_can_be_written_and_read() {
    let registry = Registry::standard();
    for name in GAMES.iter().flat_map(|game| ["Easy", "Medium", "Hard"].map(|level| format!("{game}{level}"))) {
        let [mut drawn, mut read] = [0, 1].map(|_| registry.make(&name).unwrap());
        drawn.draw_world(&mut stream(0, 2, 0, Purpose::EvalEnv));
        let text = drawn.world().to_string();
        read.set_world(&serde_json::from_str(&text).unwrap()).unwrap();
        assert_eq!(read.world(), drawn.world(), "{name}");
        let [one, other] = [drawn, read].map(|mut env| {
            play(env.as_mut(), &mut stream(0, 2, 1, Purpose::EvalEnv), |t, _, action| {
                action.discrete[0] = (t % 2) as u8;
            })
        });
        assert_eq!(one, other, "{name}");
    }
}

#[test]
fn bad_worlds_are_errors_and_change_nothing() {
    let deck: Vec<u16> = (0..52).collect();
    let mut twice = deck.clone();
    twice[7] = 8;
    let mut beyond = deck.clone();
    beyond[7] = 52;
    let odds = vec![0.5; 10];
    let with = |arm: usize, p: Json| {
        let mut odds: Vec<Json> = odds.iter().map(|&p| json!(p)).collect();
        odds[arm] = p;
        json!({ "payout_probability": odds })
    };
    let cases = [
        ("RepeatFirstEasy", json!({ "deck": deck[1..] }), "51 cards, expected 52"),
        ("RepeatFirstEasy", json!({ "deck": twice }), "card 8 is twice"),
        ("RepeatPreviousEasy", json!({ "deck": beyond }), "card 52 in the deck, allowed is 0..52"),
        ("RepeatPreviousMedium", json!({ "deck": deck }), "expected 104"),
        ("RepeatPreviousEasy", json!({ "deck": deck, "k": 4 }), "unknown field `k`"),
        ("RepeatPreviousEasy", json!({}), "missing field `deck`"),
        ("AutoencodeEasy", json!({ "deck": [] }), "0 cards, expected 52"),
        ("AutoencodeHard", json!({ "deck": deck }), "expected 156"),
        ("AutoencodeEasy", json!({ "deck": twice }), "card 8 is twice"),
        ("HigherLowerEasy", json!({ "deck": beyond }), "card 52"),
        ("HigherLowerEasy", json!({ "deck": [-1] }), "-1"),
        ("ConcentrationEasy", json!({ "deck": [70_000] }), "70000"),
        ("ConcentrationMedium", json!({ "deck": deck }), "expected 104"),
        ("ConcentrationHard", json!({ "deck": twice }), "card 8 is twice"),
        ("CountRecallEasy", json!({ "value_deck": deck }), "missing field `query_deck`"),
        ("CountRecallEasy", json!({ "value_deck": deck, "query_deck": twice }), "query_deck: card 8 is twice"),
        ("CountRecallEasy", json!({ "value_deck": beyond, "query_deck": deck }), "value_deck: card 52"),
        ("CountRecallEasy", json!({ "value_deck": deck, "query_deck": deck, "deck": deck }), "unknown field `deck`"),
        ("MultiarmedBanditEasy", json!({ "payout_probability": odds[1..] }), "9 payout probabilities, expected 10"),
        ("MultiarmedBanditMedium", json!({ "payout_probability": odds }), "10 payout probabilities, expected 20"),
        ("MultiarmedBanditEasy", with(3, json!(1.001)), "probability of arm 3 is 1.001, allowed is 0..=1"),
        ("MultiarmedBanditEasy", with(9, json!(-0.5)), "probability of arm 9 is -0.5"),
        ("MultiarmedBanditEasy", with(0, json!(1e300)), "probability of arm 0 is inf"),
        ("MultiarmedBanditEasy", with(0, Json::Null), "null"),
        ("MultiarmedBanditEasy", json!({ "payout_probability": odds, "uniform_draws": [0.5] }), "unknown field"),
        ("MultiarmedBanditEasy", json!("odds"), "odds"),
    ];
    let registry = Registry::standard();
    for (name, world, reason) in cases {
        let mut env = registry.make(name).unwrap();
        env.draw_world(&mut stream(0, 3, 0, Purpose::EvalEnv));
        let before = env.world();
        let error = env.set_world(&world).expect_err(name);
        assert!(error.contains(reason), "{name}: {error}");
        assert_eq!(env.world(), before, "{name}");
    }
    for name in ["RepeatFirstEasy", "AutoencodeEasy", "HigherLowerEasy", "ConcentrationHard"] {
        registry.make(name).unwrap().set_world(&json!({ "deck": deck })).unwrap();
    }
    registry.make("MultiarmedBanditEasy").unwrap().set_world(&json!({ "payout_probability": odds })).unwrap();
}

/// A player who forgets nothing: turns over two cards that are known to match, or else new ones, the second to match the
/// first if such a card is known.
#[test]
fn concentration_with_a_perfect_memory_returns_what_it_should() {
    const EPISODES: u64 = 1000;
    for ((level, (n, _, down)), figure) in concentration::LEVELS.into_iter().zip(TABLES).zip([0.814, 0.814, 0.698]) {
        let mut env = Concentration::new("game", level);
        let mut play_once = |index| {
            let (mut known, mut matched, mut pair) = (vec![down; n], vec![false; n], [0; 2]);
            let episode = play_drawn(&mut env, 6, index, |t, seen, action| {
                let shown = seen.row(t).discrete;
                (0..n).filter(|&place| shown[place] != down).for_each(|place| known[place] = shown[place]);
                if t > 0 && t % 2 == 0 && known[pair[0]] == known[pair[1]] {
                    (matched[pair[0]], matched[pair[1]]) = (true, true);
                }
                let partner =
                    |of: usize| (0..n).find(|&place| place != of && !matched[place] && known[place] == known[of]);
                let new = (0..n).find(|&place| known[place] == down);
                let in_pair = |&place: &usize| known[place] != down && !matched[place] && partner(place).is_some();
                pair[t % 2] = if t % 2 == 1 { partner(pair[0]).or(new) } else { (0..n).find(in_pair).or(new) }.unwrap();
                action.discrete[0] = pair[t % 2] as u8;
            });
            episode.total()
        };
        let returns: Vec<f64> = (0..EPISODES).map(&mut play_once).collect();
        let (mean, error) = mean_and_error(&returns);
        assert!((mean - figure).abs() < 4.0 * error + 5e-4, "{mean} +- {error} is not {figure}");
    }
}

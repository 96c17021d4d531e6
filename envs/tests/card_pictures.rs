//! Pictures of the card games and of the bandits: what they say, and what they must not tell.

mod common;

use std::collections::HashMap;

use common::discrete;
use popgym_envs::canvas::{Glyph, SYMBOLS};
use popgym_envs::deck::{Field, label};
use popgym_envs::{Canvas, Colour, Env, Purpose, Recorded, Registry, Slab, Style, View, stream};
use serde_json::{Value as Json, json};

const GAMES: [&str; 7] =
    ["Autoencode", "CountRecall", "RepeatFirst", "RepeatPrevious", "MultiarmedBandit", "Concentration", "HigherLower"];

/// A game in the given world after the given actions; the bandit's draws are all 0.5.
fn played(name: &str, world: &Json, actions: &[u8]) -> Box<dyn Env> {
    let mut env = Registry::standard().make(name).unwrap();
    env.set_world(world).unwrap();
    let mut observation = Slab::new(&env.spec().observation, 1);
    let mut draws = Recorded::new(vec![0.5; actions.len()]);
    env.begin(&mut draws, observation.row_mut(0));
    for &action in actions {
        env.step(discrete(&[action]), &mut draws, observation.row_mut(0));
    }
    env
}

fn picture(env: &dyn Env, view: View) -> Canvas {
    let mut canvas = Canvas::new();
    env.render(view, &mut canvas);
    canvas
}

fn text(env: &dyn Env, view: View) -> String {
    picture(env, view).to_text()
}

/// The places that stand for `action`.
fn places(canvas: &Canvas, action: u16) -> Vec<Glyph> {
    canvas.rows().iter().flatten().filter(|glyph| glyph.action == Some(action)).copied().collect()
}

fn symbols(glyphs: &[Glyph]) -> String {
    glyphs.iter().map(|glyph| glyph.symbol).collect()
}

/// Cards in the order of dealing, the rest after them in any order, as a deck that is dealt from the end.
fn dealt(first: &[u16], decks: u16) -> Vec<u16> {
    let rest = (0..52 * decks).rev().filter(|card| !first.contains(card));
    let mut deck: Vec<u16> = first.iter().copied().chain(rest).collect();
    deck.reverse();
    deck
}

#[test]
fn cards_are_called_by_rank_and_suit() {
    let cards = [0, 1, 2, 3, 36, 39, 40, 45, 51, 52 + 39];
    assert_eq!(cards.map(label), ["A♠", "A♦", "A♣", "A♥", "10♠", "10♥", "J♠", "Q♦", "K♥", "10♥"]);
    for (field, classes) in [(Field::Colour, 2), (Field::Suit, 4), (Field::Rank, 13)] {
        let red: Vec<u8> = (0..classes).filter(|&class| field.style(class).ink == Colour::Red).collect();
        assert_eq!(
            red,
            match field {
                Field::Colour => vec![1],
                Field::Suit => vec![1, 3],
                Field::Rank => vec![],
            }
        );
    }
}

/// Every action of every game has a place, every character can be drawn, and nothing stands for an action that is none,
/// from before the first episode to the end of one.
#[test]
fn pictures_can_be_drawn_and_pointed_at() {
    let registry = Registry::standard();
    for name in GAMES.iter().flat_map(|game| ["Easy", "Medium", "Hard"].map(|level| format!("{game}{level}"))) {
        let mut env = registry.make(&name).unwrap();
        let check = |env: &dyn Env| {
            for view in [View::Observed, View::Revealed] {
                let canvas = picture(env, view);
                let actions = env.spec().action.flat_width() as u16;
                assert!((0..actions).all(|action| !places(&canvas, action).is_empty()), "{name}");
                for glyph in canvas.rows().iter().flatten() {
                    let printable = glyph.symbol == ' ' || glyph.symbol.is_ascii_graphic();
                    assert!(printable || SYMBOLS.contains(glyph.symbol), "{name}: {:?}", glyph.symbol);
                    assert!(glyph.action.is_none_or(|action| action < actions), "{name}");
                }
                assert!(canvas.width() <= 80, "{name} is {} wide", canvas.width());
            }
        };
        check(env.as_ref());
        let names = env.action_names();
        assert!(names.is_empty() || names.len() == env.spec().action.flat_width());
        let space = env.spec().action.clone();
        let (mut action, mut observation) = (Slab::new(&space, 1), Slab::new(&env.spec().observation, 1));
        let [mut rng, mut policy] = [Purpose::EvalEnv, Purpose::EvalAction].map(|purpose| stream(5, 0, 0, purpose));
        env.draw_world(&mut rng);
        check(env.as_ref());
        env.begin(&mut rng, observation.row_mut(0));
        let mut step = popgym_envs::Step::default();
        while !step.done() {
            check(env.as_ref());
            space.sample_into(&mut policy, action.row_mut(0));
            step = env.step(action.row(0), &mut rng, observation.row_mut(0));
        }
        check(env.as_ref());
    }
}

/// A world and what was done in it.
type Played<'a> = (Json, &'a [u8]);

/// The two look the same to the agent, but are not.
fn assert_same(one: &dyn Env, other: &dyn Env) {
    let pictures = |view| [one, other].map(|env| picture(env, view));
    let [a, b] = pictures(View::Observed);
    assert!(a == b, "{}:\n{}{}", one.spec().id, a.to_text(), b.to_text());
    let [a, b] = pictures(View::Revealed);
    assert!(a != b, "{}:\n{}", one.spec().id, a.to_text());
}

/// Two histories with the same present observation and the same last action look the same, whatever is hidden or was
/// seen before; what is revealed differs.
#[test]
fn what_is_not_observed_is_not_drawn() {
    let deck = |first: &[u16]| json!({ "deck": dealt(first, 1) });
    let odds = |p: f32| json!({ "payout_probability": [0.75, p, 1.0, 0.0, p, 0.5, 0.5, 0.5, 0.5, 0.5] });
    let two =
        |values: &[u16], queries: &[u16]| json!({ "value_deck": dealt(values, 4), "query_deck": dealt(queries, 4) });
    let cases: [(&str, [Played; 2]); 10] = [
        ("RepeatFirstEasy", [(deck(&[0, 1, 2]), &[3, 1]), (deck(&[3, 5, 6]), &[0, 1])]),
        ("RepeatFirstEasy", [(deck(&[0, 1, 2]), &[3, 1]), (deck(&[3, 5, 7, 2]), &[0, 0, 1])]),
        ("RepeatPreviousEasy", [(deck(&[0, 1, 2, 3, 4]), &[3, 3, 3, 1]), (deck(&[3, 5, 6, 1, 8]), &[0, 0, 0, 1])]),
        ("AutoencodeEasy", [(deck(&[0, 1, 2]), &[3, 1]), (deck(&[3, 5, 6]), &[0, 1])]),
        ("HigherLowerEasy", [(deck(&[0, 8, 20]), &[1, 0]), (deck(&[51, 9, 21]), &[0, 0])]),
        ("CountRecallHard", [(two(&[0, 40, 52], &[50, 9, 60]), &[1, 2]), (two(&[9, 1], &[10, 8]), &[2])]),
        ("ConcentrationHard", [(deck(&[0, 8, 20]), &[]), (deck(&[51, 9, 21]), &[])]),
        // Two cards that do not match, then one that is the same: the two are forgotten.
        ("ConcentrationHard", [(deck(&[0, 8, 20]), &[51, 50, 49]), (deck(&[12, 33, 21]), &[51, 50, 49])]),
        ("MultiarmedBanditEasy", [(odds(0.25), &[5, 0]), (odds(0.125), &[1, 0])]),
        ("MultiarmedBanditEasy", [(odds(0.75), &[1]), (odds(1.0), &[0, 1])]),
    ];
    for (name, worlds) in cases {
        let [one, other] = worlds.map(|(world, actions)| played(name, &world, actions));
        assert_same(one.as_ref(), other.as_ref());
    }
    // When playing, no answer and no card shows how far the game is; a spade as the last card looks like no card.
    let last_spade = json!({ "deck": (0..52).collect::<Vec<u16>>() });
    let [early, late] = [52, 70].map(|steps| played("AutoencodeEasy", &last_spade, &vec![2; steps]));
    let first = played("AutoencodeEasy", &last_spade, &[2; 51]);
    for env in [&early, &first] {
        assert_same(env.as_ref(), late.as_ref());
    }
}

/// Over many episodes, one observation and one last action always make one picture.
#[test]
fn pictures_are_functions_of_what_is_observed() {
    let registry = Registry::standard();
    for name in GAMES.map(|game| format!("{game}Easy")) {
        let mut env = registry.make(&name).unwrap();
        let space = env.spec().action.clone();
        let (mut action, mut observation) = (Slab::new(&space, 1), Slab::new(&env.spec().observation, 1));
        let mut pictures: HashMap<(Vec<u8>, Option<u8>), Canvas> = HashMap::new();
        let mut again = 0;
        for index in 0..20 {
            let [mut rng, mut policy] = [Purpose::EvalEnv, Purpose::EvalAction].map(|use_| stream(6, 0, index, use_));
            env.draw_world(&mut rng);
            env.begin(&mut rng, observation.row_mut(0));
            let (mut last, mut done) = (None, false);
            while !done {
                let canvas = picture(env.as_ref(), View::Observed);
                let known = pictures.entry((observation.discrete.clone(), last)).or_insert_with(|| canvas.clone());
                assert!(*known == canvas, "{name}:\n{}{}", known.to_text(), canvas.to_text());
                again += 1;
                space.sample_into(&mut policy, action.row_mut(0));
                last = Some(action.discrete[0]);
                done = env.step(action.row(0), &mut rng, observation.row_mut(0)).done();
            }
        }
        assert!(again > pictures.len(), "{name}: nothing was seen twice");
    }
}

#[test]
fn suits_are_asked_for() {
    // Hearts, diamonds, clubs, spades, hearts.
    let world = json!({ "deck": dealt(&[3, 1, 2, 0, 7], 1) });
    let first = played("RepeatFirstEasy", &world, &[2]);
    let card = "┌───┐\n│ ♦ │\n└───┘\n";
    assert_eq!(text(first.as_ref(), View::Observed), format!("{card}the first suit?  ♠   ♦  [♣]  ♥\n"));
    let canvas = picture(first.as_ref(), View::Revealed);
    assert!(canvas.to_text().contains("\nanswer now: ♥\nsuit          ♠   ♦   ♣   ♥\nleft         13  12  13  12\n"));
    assert!(canvas.to_text().contains("\nto come:    ♣ ♠ ♥ "));
    let right = places(&canvas, 3);
    assert_eq!(
        (symbols(&right).as_str(), right[1].style.ink, right[1].style.paper),
        (" ♥ ", Colour::Red, Colour::Green)
    );
    assert!((0..3).all(|suit| places(&canvas, suit)[0].style.paper == Colour::Default));
    let names = ["spades", "diamonds", "clubs", "hearts"];
    assert_eq!(first.action_names(), names);

    let early = played("RepeatPreviousEasy", &world, &[0, 0]);
    assert!(text(early.as_ref(), View::Observed).contains("the suit 3 cards ago? [♠]  ♦   ♣   ♥\n"));
    assert!(text(early.as_ref(), View::Revealed).contains("\nanswer now: any\nlast 4:     · ♥ ♦ ♣\n"));
    let later = played("RepeatPreviousEasy", &world, &[0, 0, 0, 1]);
    assert!(
        text(later.as_ref(), View::Observed).starts_with("┌───┐\n│ ♥ │\n└───┘\nthe suit 3 cards ago?  ♠  [♦]  ♣   ♥\n")
    );
    assert!(text(later.as_ref(), View::Revealed).contains("\nanswer now: ♦\nlast 4:     ♦ ♣ ♠ ♥\n"));
    assert_eq!(later.action_names(), names);
}

#[test]
fn autoencode_says_when_to_play() {
    // The last card dealt is a heart, the one before a club.
    let world = json!({ "deck": (0..52).rev().collect::<Vec<u16>>() });
    let watching = played("AutoencodeEasy", &world, &[0, 0, 0]);
    assert!(text(watching.as_ref(), View::Observed).starts_with("┌───┐\n│ ♥ │  watch\n"));
    assert!(
        text(watching.as_ref(), View::Revealed).contains("answer now: any\nto name:    ♥ ♣ ♦ ♠\nnamed:      0 of 4\n")
    );
    let playing = played("AutoencodeEasy", &world, &[0; 52]);
    assert!(text(playing.as_ref(), View::Observed).starts_with("┌───┐\n│ ♠ │  play"));
    let revealed = picture(playing.as_ref(), View::Revealed);
    assert!(revealed.to_text().contains("answer now: ♣\nto name:    ♣ ♦ ♠ ♥ "));
    assert!(revealed.to_text().contains("named:      1 of 52\n"));
    assert_eq!(places(&revealed, 2)[0].style.paper, Colour::Green);
    assert_eq!(playing.action_names()[3], "hearts");
}

#[test]
fn count_recall_calls_classes_by_their_names() {
    // Values: king, queen, 10, 10; queries: jack, ace, 2, 10.
    let world = json!({ "value_deck": dealt(&[50, 46, 36, 88], 4), "query_deck": dealt(&[41, 1, 5, 37], 4) });
    let ranks = played("CountRecallHard", &world, &[0, 16, 9]);
    let seen = text(ranks.as_ref(), View::Observed);
    assert_eq!(
        seen.lines().collect::<Vec<_>>(),
        [
            "value       query",
            "┌───┐       ┌───┐",
            "│10 │       │10 │",
            "└───┘       └───┘",
            "how many values of rank 10 so far?",
            "  0   1   2   3   4   5   6   7   8",
            "[ 9] 10  11  12  13  14  15  16",
        ]
    );
    let canvas = picture(ranks.as_ref(), View::Revealed);
    let rows = "\nanswer now: 2\n\
        rank          A   2   3   4   5   6   7   8   9  10   J   Q   K\n\
        values        0   0   0   0   0   0   0   0   0   2   0   1   1\n\
        queries       1   1   0   0   0   0   0   0   0   1   1   0   0\n\
        left:       204 of each\n";
    assert!(canvas.to_text().contains(rows), "{}", canvas.to_text());
    let green: Vec<u16> = (0..17).filter(|&n| places(&canvas, n)[0].style.paper == Colour::Green).collect();
    assert_eq!(green, [2]);

    let world = json!({ "value_deck": dealt(&[3], 2), "query_deck": dealt(&[2], 2) });
    let suits = text(played("CountRecallMedium", &world, &[]).as_ref(), View::Revealed);
    assert!(suits.contains("│ ♥ │       │ ♣ │\n") && suits.contains("of suit ♣ so far?") && suits.contains("now: 0\n"));
    assert!(suits.contains(" 26\n") && !suits.contains(" 27"));
    let world = json!({ "value_deck": dealt(&[3], 1), "query_deck": dealt(&[1], 1) });
    let colours = played("CountRecallEasy", &world, &[]);
    let canvas = picture(colours.as_ref(), View::Observed);
    assert!(canvas.to_text().contains("│ red │     │ red │\n"));
    assert_eq!(canvas.rows()[2][2].style, Style::ink(Colour::Red));
    assert!(text(colours.as_ref(), View::Revealed).contains("colour      black   red\nvalues          0     1\n"));
}

#[test]
fn higher_lower_shows_the_rank_alone() {
    // 10, jack, jack, 2.
    let world = json!({ "deck": dealt(&[39, 40, 41, 4], 1) });
    let answers = [("higher", Some(0)), ("any (equal)", None), ("lower", Some(1))];
    for (t, (answer, right)) in answers.into_iter().enumerate() {
        let env = played("HigherLowerEasy", &world, &vec![1; t]);
        let card = ["│10 │", "│ J │", "│ J │"][t];
        let lower = if t == 0 { " lower" } else { "[lower]" };
        let seen = format!("┌───┐\n{card}\n└───┘\nthe next card is  higher  {lower}\n");
        assert_eq!(text(env.as_ref(), View::Observed), seen);
        let canvas = picture(env.as_ref(), View::Revealed);
        assert!(canvas.to_text().contains(&format!("\nanswer now: {answer}\n")));
        let green = [0, 1].into_iter().find(|&action| places(&canvas, action)[0].style.paper == Colour::Green);
        assert_eq!(green, right);
        assert_eq!(env.action_names(), ["higher", "lower"]);
    }
    let end = played("HigherLowerEasy", &world, &[0; 51]);
    assert!(text(end.as_ref(), View::Revealed).contains("answer now: none\n"));
}

#[test]
fn concentration_draws_every_card_of_two_decks() {
    // Place p holds card p: red are the odd ones.
    let world = json!({ "deck": (0..104).collect::<Vec<u16>>() });
    let env = played("ConcentrationMedium", &world, &[1, 103, 0, 102, 50]);
    let seen = picture(env.as_ref(), View::Observed);
    let down = " ░░░ ".repeat(10);
    let lines: Vec<String> = seen.rows().iter().map(|row| symbols(row)).collect();
    assert_eq!((lines.len(), seen.width()), (8, 65));
    assert_eq!(lines[0], format!("  B    R   ░░░ {down}"));
    assert_eq!(lines[3], format!("{down} ░░░ [ B ] ░░░ "));
    assert_eq!(lines[7], format!("{down} ░░░   B    R  "));
    assert_eq!(places(&seen, 103)[2], Glyph { symbol: 'R', style: Style::ink(Colour::Red), action: Some(103) });
    let revealed = picture(env.as_ref(), View::Revealed);
    assert!((0..104).all(|place| symbols(&places(&revealed, place)).contains(&label(place))));
    let paper = |place| places(&revealed, place)[0].style.paper;
    assert_eq!([0, 1, 102, 103].map(paper), [Colour::Green; 4]);
    assert_eq!([paper(50), paper(2)], [Colour::Blue, Colour::Default]);
    assert!(revealed.to_text().contains("matched: 4 of 104 cards\nturned over: 5 of at most 208\n"));
}

#[test]
fn concentration_ranks_can_be_told_apart() {
    let world = json!({ "deck": (0..52).collect::<Vec<u16>>() });
    let flips: Vec<u8> = (0..13).flat_map(|rank| [4 * rank, 4 * rank + 1]).collect();
    let env = played("ConcentrationHard", &world, &flips);
    let seen = text(env.as_ref(), View::Observed);
    let lines = [
        "  A    A   ░░░  ░░░   2    2   ░░░  ░░░   3    3   ░░░  ░░░   4",
        "  4   ░░░  ░░░   5    5   ░░░  ░░░   6    6   ░░░  ░░░   7    7",
        " ░░░  ░░░   8    8   ░░░  ░░░   9    9   ░░░  ░░░  10   10   ░░░",
        " ░░░   J    J   ░░░  ░░░   Q    Q   ░░░  ░░░   K  [ K ] ░░░  ░░░",
    ];
    assert_eq!(seen.lines().collect::<Vec<_>>(), lines);
}

#[test]
fn bandits_show_payouts_and_reveal_odds() {
    let world = json!({ "payout_probability": [0.75, 0.25, 1.0, 0.0, 0.5, 0.5, 0.5, 0.5, 0.5, 0.94] });
    let seen = |actions: &[u8]| text(played("MultiarmedBanditEasy", &world, actions).as_ref(), View::Observed);
    assert!(seen(&[]).starts_with("pull an arm\n"));
    assert!(seen(&[0]).starts_with("arm 0: paid\n\n[  0]\n   1\n"));
    assert!(seen(&[0, 1]).starts_with("arm 1: nothing\n\n   0\n[  1]\n"));
    let canvas = picture(played("MultiarmedBanditEasy", &world, &[9]).as_ref(), View::Revealed);
    let lines = canvas.to_text();
    let lines: Vec<&str> = lines.lines().collect();
    assert_eq!(
        lines[2..6],
        ["   0  ████████░░ 0.75", "   1  ███░░░░░░░ 0.25", "   2  ██████████ 1.00", "   3  ░░░░░░░░░░ 0.00"]
    );
    assert_eq!(lines[11], "[  9] █████████░ 0.94");
    assert_eq!(lines[13], "steps left: 199");
    assert_eq!(places(&canvas, 2)[0].style.paper, Colour::Green);
}

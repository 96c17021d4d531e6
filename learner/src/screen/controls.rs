//! From keys to actions, for every kind of action space.
//!
//! | action space | keys |
//! |---|---|
//! | `Discrete` with names | arrows where names are directions, first letters where no two names share one |
//! | `Discrete(n)`, `n` up to 10 | the digits, too |
//! | one bounded real | arrows for both ends, down for 0, digits from end to end |
//! | any other | its numbers, typed, and Enter |
//! | any whose picture has places for actions | a cursor, unless the arrows have a meaning already |

use popgym_envs::space::Leaf;
use popgym_envs::{Canvas, Space, Value};

use super::joint::Joint;
use super::key::{Direction, Key};
use super::places::Cursor;
use crate::space_text::number;

/// More classes than this have no digit each.
const DIGITS: usize = 10;

/// Longest entry, in characters.
const LONGEST: usize = 200;

/// A point of an action space.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Action {
    discrete: Vec<u8>,
    real: Vec<f32>,
}

impl Action {
    /// As environments take it.
    pub(crate) fn value(&self) -> Value<'_> {
        Value { discrete: &self.discrete, real: &self.real }
    }
}

/// What came of a key.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Pressed {
    /// This action was chosen.
    Action(Action),
    /// The cursor or the entry has changed, or nothing has.
    Nothing,
    /// What was typed is no action, in one sentence.
    Refused(String),
}

/// The keys of one action space.
pub(crate) struct Controls {
    space: Space,
    joint: Option<Joint>,
    names: Vec<String>,
    shortcuts: Vec<(Key, Action)>,
    /// What was typed so far; `None`: here nothing is typed.
    typed: Option<String>,
    cursor: Cursor,
}

impl Controls {
    /// Keys for `space`, whose classes are called `names` (there may be none).
    pub(crate) fn new(space: &Space, names: &[&str]) -> Self {
        let joint = Joint::of(space);
        let names: Vec<String> = names.iter().map(|&name| name.to_owned()).collect();
        let shortcuts = match (&joint, bar(space)) {
            (Some(joint), _) if joint.components() == 1 => class_shortcuts(joint.count(), &names),
            (_, Some(bounds)) => bar_shortcuts(bounds),
            _ => Vec::new(),
        };
        let has_digits = shortcuts.iter().any(|(key, _)| *key == Key::Char('0'));
        let typed = (!has_digits).then(String::new);
        Self { space: space.clone(), joint, names, shortcuts, typed, cursor: Cursor::default() }
    }

    /// Takes the places of the present picture, for the cursor.
    pub(crate) fn see(&mut self, picture: &Canvas) {
        if let Some(joint) = &self.joint
            && !self.shortcuts.iter().any(|(key, _)| matches!(key, Key::Arrow(_)))
        {
            self.cursor.see(picture, joint.count());
        }
    }

    /// Shows the cursor in the picture.
    pub(crate) fn mark(&self, picture: &mut Canvas) {
        self.cursor.mark(picture);
    }

    /// What a key does.
    pub(crate) fn press(&mut self, key: Key) -> Pressed {
        if let Some((_, action)) = self.shortcuts.iter().find(|(shortcut, _)| *shortcut == key) {
            return Pressed::Action(action.clone());
        }
        let typed = self.typed.as_deref().unwrap_or_default();
        match key {
            Key::Arrow(direction) => {
                self.cursor.go(direction);
            }
            Key::Enter | Key::Char(' ') if typed.is_empty() => {
                return self.pointed().map_or(Pressed::Nothing, Pressed::Action);
            }
            Key::Enter => return self.enter(),
            Key::Backspace => {
                self.typed.as_mut().and_then(String::pop);
            }
            Key::Char(symbol) if symbol.is_ascii_digit() || " ,.-+".contains(symbol) => {
                if let Some(typed) = self.typed.as_mut().filter(|typed| typed.len() < LONGEST) {
                    typed.push(symbol);
                }
            }
            _ => {}
        }
        Pressed::Nothing
    }

    /// What has been typed so far.
    pub(crate) fn typed(&self) -> &str {
        self.typed.as_deref().unwrap_or_default()
    }

    /// The name of the action that the cursor points at.
    pub(crate) fn pointed_name(&self) -> Option<String> {
        let index = usize::from(self.cursor.action()?);
        Some(self.name(index))
    }

    /// An action in words.
    pub(crate) fn describe(&self, action: Value<'_>) -> String {
        match &self.joint {
            Some(joint) => self.name(joint.index(action.discrete)),
            None => crate::space_text::value_text(&self.space, action),
        }
    }

    /// Keys, and what they do, line by line.
    pub(crate) fn help(&self) -> Vec<(String, String)> {
        let mut help = Vec::new();
        if let Some((low, high)) = bar(&self.space) {
            let [low, high] = [low, high].map(|x| number(f64::from(x)));
            help.push(("← →".to_owned(), format!("{low}, {high}")));
            help.push(("↓".to_owned(), "0, or the nearest to it".to_owned()));
            help.push(("0 to 9".to_owned(), format!("from {low} to {high}")));
        } else if let Some(joint) = &self.joint {
            let keyed = (0..joint.count()).map(|index| (self.keys(&joint.classes(index)), self.name(index)));
            help.extend(keyed.filter(|(keys, _)| !keys.is_empty()));
        }
        if self.cursor.action().is_some() {
            help.push(("arrows".to_owned(), "point at a place".to_owned()));
            help.push(("Enter".to_owned(), "act there".to_owned()));
        }
        if self.typed.is_some() {
            help.push(self.typing_help());
        }
        help
    }

    fn typing_help(&self) -> (String, String) {
        let what = match &self.joint {
            Some(joint) if joint.components() == 1 => format!("a number, 0 to {}", joint.count() - 1),
            Some(joint) => {
                let last = joint.classes(joint.count() - 1);
                format!("two numbers, 0 to {} and 0 to {}", last[0], last[1])
            }
            None => format!("{} numbers", self.space.leaves().len()),
        };
        ("0-9 Enter".to_owned(), what)
    }

    /// The keys of the action with these classes, apart by blanks.
    fn keys(&self, classes: &[u8]) -> String {
        let keys = self.shortcuts.iter().filter(|(_, action)| action.discrete == classes);
        keys.map(|(key, _)| key.to_string()).collect::<Vec<_>>().join(" ")
    }

    fn name(&self, index: usize) -> String {
        let names: Vec<&str> = self.names.iter().map(String::as_str).collect();
        self.joint.as_ref().map_or_else(String::new, |joint| joint.name(index, &names))
    }

    fn pointed(&self) -> Option<Action> {
        let joint = self.joint.as_ref()?;
        let index = usize::from(self.cursor.action()?);
        Some(Action { discrete: joint.classes(index), real: Vec::new() })
    }

    /// The end of an entry.
    fn enter(&mut self) -> Pressed {
        let text = self.typed.as_mut().map(std::mem::take).unwrap_or_default();
        match parse(&self.space, &text) {
            Ok(action) => Pressed::Action(action),
            Err(problem) => Pressed::Refused(problem),
        }
    }
}

/// The bounds of a space that is one bounded real.
fn bar(space: &Space) -> Option<(f32, f32)> {
    match space.leaves()[..] {
        [Leaf::Real { low, high }] if low.is_finite() && high.is_finite() => Some((low, high)),
        _ => None,
    }
}

fn class_shortcuts(count: usize, names: &[String]) -> Vec<(Key, Action)> {
    let named = names.iter().enumerate().take(count);
    let named = named.flat_map(|(class, name)| [direction(name, names), letter(name, names)].map(|key| (class, key)));
    let digits =
        (0..count).filter(|_| count <= DIGITS).map(|class| (class, char::from_digit(class as u32, 10).map(Key::Char)));
    let keyed = named.chain(digits).filter_map(|(class, key)| Some((class, key?)));
    keyed.map(|(class, key)| (key, Action { discrete: vec![class as u8], real: Vec::new() })).collect()
}

/// The arrow of a name that has exactly one word for a direction (`left`, `push left`), if no other name has it too.
fn direction(name: &str, names: &[String]) -> Option<Key> {
    let arrow = |name: &str| {
        let mut words = name.split(|c: char| !c.is_alphanumeric());
        let mut found = words.by_ref().filter_map(|word| {
            Direction::ALL
                .into_iter()
                .find(|direction| direction.words().iter().any(|known| known.eq_ignore_ascii_case(word)))
        });
        found.next().filter(|_| found.next().is_none())
    };
    let own = arrow(name)?;
    (names.iter().filter(|other| arrow(other) == Some(own)).count() == 1).then_some(Key::Arrow(own))
}

/// The first letter of a name, if no other name has it too; `q` leaves.
fn letter(name: &str, names: &[String]) -> Option<Key> {
    let first = |name: &str| name.chars().next().map(|symbol| symbol.to_ascii_lowercase());
    let own = first(name).filter(|symbol| symbol.is_ascii_alphabetic() && *symbol != 'q')?;
    (names.iter().filter(|other| first(other) == Some(own)).count() == 1).then_some(Key::Char(own))
}

fn bar_shortcuts((low, high): (f32, f32)) -> Vec<(Key, Action)> {
    let share = |digit: u8| low + (high - low) * f32::from(digit) / 9.0;
    let digits = (0..=9).map(|digit| (Key::Char(char::from(b'0' + digit)), share(digit)));
    let arrows = [(Direction::Left, low), (Direction::Right, high), (Direction::Down, 0.0)];
    let all = arrows.map(|(direction, x)| (Key::Arrow(direction), x)).into_iter().chain(digits);
    all.map(|(key, x)| (key, Action { discrete: Vec::new(), real: vec![x.clamp(low, high)] })).collect()
}

/// Numbers apart by blanks or commas, one for each component of `space`, in its order.
fn parse(space: &Space, text: &str) -> Result<Action, String> {
    let words: Vec<&str> = text.split([' ', ',']).filter(|word| !word.is_empty()).collect();
    let leaves = space.leaves();
    if words.len() != leaves.len() {
        let plural = if leaves.len() == 1 { "" } else { "s" };
        return Err(format!("an action is {} number{plural}, `{}` has {}", leaves.len(), text.trim(), words.len()));
    }
    let mut action = Action::default();
    for (word, leaf) in words.iter().zip(leaves) {
        match leaf {
            Leaf::Discrete { classes } => {
                let class = word.parse().ok().filter(|class: &u8| u16::from(*class) < classes);
                action.discrete.push(class.ok_or_else(|| format!("`{word}` is no action: 0 to {}", classes - 1))?);
            }
            Leaf::Real { low, high } => {
                let x = word.parse().ok().filter(|x: &f32| x.is_finite() && (low..=high).contains(x));
                let [low, high] = [low, high].map(|x| number(f64::from(x)));
                action.real.push(x.ok_or_else(|| format!("`{word}` is no action: {low} to {high}"))?);
            }
        }
    }
    Ok(action)
}

#[cfg(test)]
mod tests {
    use popgym_envs::Style;

    use super::*;

    fn class(class: u8) -> Pressed {
        Pressed::Action(Action { discrete: vec![class], real: Vec::new() })
    }

    fn real(x: f32) -> Pressed {
        Pressed::Action(Action { discrete: Vec::new(), real: vec![x] })
    }

    fn arrow(direction: Direction) -> Key {
        Key::Arrow(direction)
    }

    /// Types `text`; gives what came of Enter.
    fn enter(controls: &mut Controls, text: &str) -> Pressed {
        text.chars().for_each(|symbol| assert_eq!(controls.press(Key::Char(symbol)), Pressed::Nothing));
        assert_eq!(controls.typed(), text);
        controls.press(Key::Enter)
    }

    #[test]
    fn directions_letters_and_digits() {
        let mut controls = Controls::new(&Space::Discrete(4), &["Right", "up", "left", "down"]);
        for (key, expected) in [(arrow(Direction::Right), 0), (arrow(Direction::Up), 1), (arrow(Direction::Left), 2)] {
            assert_eq!(controls.press(key), class(expected));
        }
        for (symbol, expected) in [('r', 0), ('u', 1), ('l', 2), ('d', 3), ('0', 0), ('3', 3)] {
            assert_eq!(controls.press(Key::Char(symbol)), class(expected));
        }
        for key in [Key::Char('4'), Key::Char('x'), Key::Enter, Key::Backspace] {
            assert_eq!(controls.press(key), Pressed::Nothing);
        }
        assert_eq!(controls.help()[0], ("→ r 0".to_owned(), "Right".to_owned()));
        // No cursor: the arrows have a meaning.
        let mut picture = Canvas::new();
        picture.put_action(0, 0, "x", Style::PLAIN, 1);
        controls.see(&picture);
        assert_eq!(controls.pointed_name(), None);
    }

    #[test]
    fn names_that_share_a_letter_or_a_direction_or_begin_with_q() {
        let mut controls = Controls::new(&Space::Discrete(5), &["hold", "hit", "quit", "push left", "pull left"]);
        for symbol in ['h', 'q', 'p'] {
            assert_eq!(controls.press(Key::Char(symbol)), Pressed::Nothing);
        }
        assert_eq!(controls.press(arrow(Direction::Left)), Pressed::Nothing);
        assert_eq!(controls.press(Key::Char('4')), class(4));
        for (names, expected) in
            [(["push left", "push right"], Direction::Right), (["right", "forward"], Direction::Up)]
        {
            assert_eq!(Controls::new(&Space::Discrete(2), &names).press(arrow(expected)), class(1));
        }
        // More names than actions are of no use.
        let mut controls = Controls::new(&Space::Discrete(1), &["one", "two"]);
        assert_eq!(
            (controls.press(Key::Char('t')), controls.press(Key::Char('1'))),
            (Pressed::Nothing, Pressed::Nothing)
        );
    }

    #[test]
    fn many_classes_are_typed() {
        let mut controls = Controls::new(&Space::Discrete(30), &[]);
        assert_eq!(enter(&mut controls, "27"), class(27));
        assert_eq!(controls.typed(), "", "the next entry is another");
        let refused = |pressed| match pressed {
            Pressed::Refused(problem) => problem,
            other => panic!("{other:?}"),
        };
        assert_eq!(refused(enter(&mut controls, "30")), "`30` is no action: 0 to 29");
        assert_eq!(refused(enter(&mut controls, "999")), "`999` is no action: 0 to 29");
        assert_eq!(refused(enter(&mut controls, "1 2")), "an action is 1 number, `1 2` has 2");
        assert_eq!(enter(&mut controls, "2"), class(2));
        controls.press(Key::Char('1'));
        controls.press(Key::Char('5'));
        controls.press(Key::Backspace);
        assert_eq!(controls.press(Key::Enter), class(1));
        assert_eq!(controls.press(Key::Enter), Pressed::Nothing, "an empty entry");
        (0..300).for_each(|_| assert_eq!(controls.press(Key::Char('1')), Pressed::Nothing));
        assert_eq!(controls.typed().len(), LONGEST);
    }

    #[test]
    fn a_board_has_a_cursor_and_coordinates() {
        let mut controls = Controls::new(&Space::MultiDiscrete(vec![2, 3]), &[]);
        assert_eq!(controls.press(Key::Enter), Pressed::Nothing, "nothing to point at yet");
        let mut picture = Canvas::new();
        for index in 0..6 {
            picture.put_action(usize::from(index / 3), 2 * usize::from(index % 3), "x", Style::PLAIN, index);
        }
        controls.see(&picture);
        for direction in [Direction::Right, Direction::Down, Direction::Right] {
            assert_eq!(controls.press(arrow(direction)), Pressed::Nothing);
        }
        assert_eq!(controls.pointed_name().as_deref(), Some("(1, 2)"));
        let chosen = Pressed::Action(Action { discrete: vec![1, 2], real: Vec::new() });
        assert_eq!(controls.press(Key::Char(' ')), chosen);
        assert_eq!(controls.press(Key::Enter), chosen);
        assert_eq!(enter(&mut controls, "0, 2"), Pressed::Action(Action { discrete: vec![0, 2], real: Vec::new() }));
        assert!(matches!(enter(&mut controls, "2 0"), Pressed::Refused(_)));
    }

    #[test]
    fn one_real_is_a_bar() {
        let mut controls = Controls::new(&Space::uniform_box(1, -2.0, 2.0), &[]);
        for (direction, x) in [(Direction::Left, -2.0), (Direction::Right, 2.0), (Direction::Down, 0.0)] {
            assert_eq!(controls.press(arrow(direction)), real(x));
        }
        assert_eq!((controls.press(Key::Char('0')), controls.press(Key::Char('9'))), (real(-2.0), real(2.0)));
        let Pressed::Action(Action { real, .. }) = controls.press(Key::Char('6')) else { panic!("no action") };
        assert!((real[0] - 2.0 / 3.0).abs() < 1e-6, "two thirds of the way from -2 to 2: {real:?}");
        // Where 0 is no action, the nearest that is.
        let mut controls = Controls::new(&Space::uniform_box(1, 1.0, 5.0), &[]);
        assert_eq!(controls.press(arrow(Direction::Down)), self::real(1.0));
    }

    #[test]
    fn any_other_space_is_typed() {
        let space = Space::Tuple(vec![Space::uniform_box(2, -1.0, 1.0), Space::MultiDiscrete(vec![2, 3, 4])]);
        let mut controls = Controls::new(&space, &[]);
        let expected = Action { discrete: vec![1, 0, 3], real: vec![0.5, -1.0] };
        assert_eq!(enter(&mut controls, "0.5 -1 1 0 3"), Pressed::Action(expected.clone()));
        assert!(space.check(expected.value()).is_ok());
        assert!(matches!(enter(&mut controls, "0.5 -2 1 0 3"), Pressed::Refused(_)));
        assert!(matches!(enter(&mut controls, "0.5 - 1 0 3"), Pressed::Refused(_)));
        let mut unbounded = Controls::new(&Space::uniform_box(1, f32::NEG_INFINITY, f32::INFINITY), &[]);
        assert_eq!(enter(&mut unbounded, "-1000.5"), real(-1000.5));
    }
}

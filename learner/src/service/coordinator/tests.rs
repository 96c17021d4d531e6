//! Whose leases are overdue.

use popgym_proto::PROTOCOL_VERSION;

use super::*;

/// A session that is there, and what it is told.
type Seat = (mpsc::Receiver<Order>, oneshot::Receiver<Result<(), Status>>);

fn join(coordinator: &mut Coordinator, session: u64) -> Seat {
    let ((orders, told), (reply, accepted)) = (mpsc::channel(limits::SESSION_QUEUE), oneshot::channel());
    let hello = Hello {
        protocol_version: PROTOCOL_VERSION,
        build: String::new(),
        actor: "actor".to_owned(),
        key: session,
        incarnation: 1,
        slots: 8,
        run: None,
    };
    coordinator.handle(Event::Joined { session, hello, orders, reply });
    (told, accepted)
}

/// A coordinator with two sessions, 0 and 1, each with ten leases of an open epoch.
fn coordinator() -> (Coordinator, [Seat; 2]) {
    let mut coordinator =
        Coordinator::new(100, std::sync::mpsc::channel().0, Arc::default(), Account::default(), Arc::default());
    let weights = WeightSet::new(0, bytes::Bytes::from_static(b"\x02\0\0\0\0\0\0\0{}")).unwrap();
    let seats = [0, 1].map(|session| join(&mut coordinator, session));
    coordinator.handle(Event::Open { epoch: 0, weights, target: Target::Episodes(20) });
    coordinator.lease();
    assert_eq!(held(&coordinator), [(0, 10), (1, 10)]);
    (coordinator, seats)
}

fn held(coordinator: &Coordinator) -> Vec<(u64, usize)> {
    coordinator.sessions.iter().map(|(&id, session)| (id, session.held.len())).collect()
}

fn send_all(coordinator: &mut Coordinator, session: u64) {
    let episode = |&index: &u64| Episode { index, steps: 1, ..Episode::default() };
    let episodes = coordinator.sessions[&session].held.keys().map(episode).collect();
    coordinator.handle(Event::Episodes { session, batch: EpisodeBatch { epoch: 0, version: 0, episodes } });
}

#[test]
fn who_keeps_the_others_waiting_loses_its_leases() {
    let (mut coordinator, [mut idle, _working]) = coordinator();
    send_all(&mut coordinator, 1);
    let now = Instant::now();
    coordinator.take_overdue(now + limits::LEASE_PATIENCE.saturating_sub(Duration::from_secs(1)));
    assert_eq!(held(&coordinator), [(0, 10), (1, 0)]);
    coordinator.take_overdue(now + limits::LEASE_PATIENCE + Duration::from_secs(1));
    coordinator.lease();
    assert_eq!(held(&coordinator), [(1, 10)]);
    assert_eq!(coordinator.epoch.as_ref().unwrap().patience, 2 * limits::LEASE_PATIENCE);
    assert!(std::iter::from_fn(|| idle.0.try_recv().ok()).any(|order| matches!(order, Order::Overdue)));
}

#[test]
fn nobody_is_hurried_for_whom_nobody_waits() {
    let (mut coordinator, _seats) = coordinator();
    let tomorrow = Instant::now() + Duration::from_hours(24);
    coordinator.take_overdue(tomorrow);
    assert_eq!(held(&coordinator), [(0, 10), (1, 10)], "all are at it");
}

#[test]
fn a_newcomer_waits_as_long_as_anyone() {
    let (mut coordinator, _seats) = coordinator();
    let now = Instant::now();
    let _newcomer = join(&mut coordinator, 2);
    coordinator.take_overdue(now + limits::LEASE_PATIENCE.saturating_sub(Duration::from_secs(1)));
    assert_eq!(held(&coordinator), [(0, 10), (1, 10), (2, 0)]);
    coordinator.take_overdue(now + limits::LEASE_PATIENCE + Duration::from_secs(1));
    coordinator.lease();
    let held = held(&coordinator);
    assert!(matches!(held[..], [(2, 8..)]), "{held:?}");
}

#[test]
fn an_episode_now_and_then_buys_no_time() {
    let (mut coordinator, _seats) = coordinator();
    send_all(&mut coordinator, 1);
    let now = Instant::now();
    let index = *coordinator.sessions[&0].held.first_key_value().unwrap().0;
    let episodes = vec![Episode { index, steps: 1, ..Episode::default() }];
    coordinator.handle(Event::Episodes { session: 0, batch: EpisodeBatch { epoch: 0, version: 0, episodes } });
    let (number, at) = coordinator.sessions[&0].worked.unwrap();
    coordinator.sessions.get_mut(&0).unwrap().worked = Some((number, at + Duration::from_secs(299)));
    coordinator.take_overdue(now + limits::LEASE_PATIENCE + Duration::from_secs(1));
    assert_eq!(held(&coordinator), [(1, 0)]);
}

#[test]
fn slow_work_is_waited_for() {
    let (mut coordinator, _seats) = coordinator();
    let minutes = Duration::from_mins;
    let now = Instant::now();
    send_all(&mut coordinator, 1);
    let (number, at) = coordinator.sessions[&1].worked.unwrap();
    coordinator.sessions.get_mut(&1).unwrap().worked = Some((number, at + minutes(10)));
    coordinator.take_overdue(now + minutes(39));
    assert_eq!(held(&coordinator), [(0, 10), (1, 0)]);
    coordinator.take_overdue(now + minutes(41));
    assert_eq!(held(&coordinator), [(1, 0)]);
}

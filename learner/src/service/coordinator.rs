//! The single owner of sessions, leases and received episodes: one task, no locks.
//!
//! At any moment at most one epoch is open. Its episodes are numbered from 0; each is leased to one session at a time;
//! those of a session that ends are leased again, lowest number first. The batch is the shortest prefix that reaches the
//! target, so it does not depend on who sampled what, or when.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use popgym_proto::{Episode, EpisodeBatch, Hello, Leases, OpenEpoch, WeightSet, limits};
use tokio::sync::mpsc::error::TrySendError;
use tokio::sync::{mpsc, oneshot};
use tonic::Status;
use tracing::info;

use super::account::{Account, Entry, ranges};
use super::planner::{LengthEstimate, Progress, Seat, Target, assign, further_leases};
use super::roster::{ActorView, Roster};
use super::session::Order;
use super::{Collected, metrics};

/// What reaches the coordinator.
#[derive(Debug)]
pub(super) enum Event {
    /// An actor is ready.
    Joined { session: u64, hello: Hello, orders: mpsc::Sender<Order>, reply: oneshot::Sender<Result<(), Status>> },
    /// An actor sent legal episodes.
    Episodes { session: u64, batch: EpisodeBatch },
    /// A session has ended.
    Left { session: u64, reason: String },
    /// The trainer opens an epoch.
    Open { epoch: u64, weights: WeightSet, target: Target },
    /// The trainer stops: tell all actors, answer when they have gone.
    Finish { farewell: Farewell, gone: oneshot::Sender<()> },
}

/// Why the trainer stops.
#[derive(Clone, Debug)]
pub(super) enum Farewell {
    /// The run is complete, for this reason: actors end.
    Complete(String),
    /// The run is to go on later: actors wait for a learner.
    Pause,
}

impl Farewell {
    fn order(&self) -> Order {
        match self {
            Self::Complete(reason) => Order::Stop { reason: reason.clone() },
            Self::Pause => Order::End(Status::unavailable("the learner was asked to stop; it may return")),
        }
    }
}

/// Names of actors that are remembered, to tell who returns. Beyond, an actor that returns looks new; nothing else.
const MAX_KNOWN_ACTORS: usize = 65_536;

/// How often the roster is written anew, at most.
const ROSTER_INTERVAL: Duration = Duration::from_secs(1);

struct Session {
    /// Its actor's name, or, where another session has that, one like it.
    actor: String,
    hello: Hello,
    orders: mpsc::Sender<Order>,
    /// Version of the weights that were sent to it.
    version: Option<u64>,
    /// Its leases, and since when it has them.
    held: BTreeMap<u64, Instant>,
    joined: Instant,
    /// The epoch that it last sent an episode of, and when.
    worked: Option<(u64, Instant)>,
    /// Episodes accepted from it, and their steps.
    episodes: u64,
    steps: u64,
}

struct Epoch {
    number: u64,
    weights: WeightSet,
    target: Target,
    opened: Instant,
    /// How long leases may wait while others have nothing to do.
    patience: Duration,
    /// The lowest number that was never leased.
    next: u64,
    /// Numbers that were leased, and lost.
    lost: BTreeSet<u64>,
    /// Number -> who has it.
    holders: HashMap<u64, u64>,
    received: BTreeMap<u64, Episode>,
    received_steps: u64,
    /// Length of the prefix that is complete, and its steps; never beyond the batch.
    prefix: u64,
    prefix_steps: u64,
}

pub(super) struct Coordinator {
    sessions: BTreeMap<u64, Session>,
    /// Names that have been here.
    known: HashSet<String>,
    /// `None`: nothing to sample at the moment.
    epoch: Option<Epoch>,
    length: LengthEstimate,
    results: std::sync::mpsc::Sender<Collected>,
    roster: Arc<Roster>,
    account: Account,
    /// Why the run is complete, for who comes when all this has gone.
    complete: Arc<OnceLock<String>>,
    finishing: Option<(Farewell, oneshot::Sender<()>)>,
}

impl Coordinator {
    pub(super) fn new(
        max_steps: u32,
        results: std::sync::mpsc::Sender<Collected>,
        roster: Arc<Roster>,
        account: Account,
        complete: Arc<OnceLock<String>>,
    ) -> Self {
        Self {
            sessions: BTreeMap::new(),
            known: HashSet::new(),
            epoch: None,
            length: LengthEstimate::unknown(max_steps),
            results,
            roster,
            account,
            complete,
            finishing: None,
        }
    }

    /// Handles events until all who could send one have gone.
    pub(super) async fn run(mut self, mut events: mpsc::Receiver<Event>) {
        let mut pending = Vec::with_capacity(limits::COORDINATOR_QUEUE);
        let mut clock = tokio::time::interval(limits::HEARTBEAT_INTERVAL);
        let mut shown = Instant::now();
        self.show();
        loop {
            // All that has arrived is handled before leases are planned: one plan, not one for each message.
            tokio::select! {
                received = events.recv_many(&mut pending, limits::COORDINATOR_QUEUE) => {
                    if received == 0 {
                        return;
                    }
                }
                _ = clock.tick() => self.take_overdue(Instant::now()),
            }
            let queued = events.len() + pending.len();
            for event in pending.drain(..) {
                self.handle(event);
            }
            self.close_if_complete();
            self.lease();
            self.account.flush();
            metrics::queues(queued, self.epoch.as_ref().map_or(0, |epoch| epoch.holders.len()));
            if shown.elapsed() >= ROSTER_INTERVAL {
                shown = Instant::now();
                self.show();
            }
            if self.sessions.is_empty()
                && let Some((_, gone)) = self.finishing.take()
            {
                // The trainer may have stopped waiting.
                let _ = gone.send(());
                return;
            }
        }
    }

    fn handle(&mut self, event: Event) {
        match event {
            Event::Joined { session, hello, orders, reply } => {
                let answer = self.join(session, hello, orders);
                let accepted = answer.is_ok();
                if reply.send(answer).is_err() && accepted {
                    self.leave(session, "closed its connection");
                } else if accepted {
                    self.greet(session);
                }
            }
            Event::Episodes { session, batch } => self.receive(session, batch),
            Event::Left { session, reason } => self.leave(session, &reason),
            Event::Open { epoch, weights, target } => self.open(epoch, weights, target),
            Event::Finish { farewell, gone } => {
                if let Farewell::Complete(reason) = &farewell {
                    self.account.write(Entry::Finished { reason });
                    // Told but once.
                    let _ = self.complete.set(reason.clone());
                }
                self.epoch = None;
                self.finishing = Some((farewell.clone(), gone));
                self.order_all(|_| Some(farewell.order()));
            }
        }
    }

    fn join(&mut self, session: u64, hello: Hello, orders: mpsc::Sender<Order>) -> Result<(), Status> {
        if self.sessions.len() >= limits::MAX_SESSIONS {
            let full = format!("this learner has {} actors, which is the most it takes", limits::MAX_SESSIONS);
            return Err(Status::resource_exhausted(full));
        }
        let own = |older: &Hello| older.actor == hello.actor && older.key == hello.key;
        let older = self.sessions.iter().find(|(_, session)| own(&session.hello));
        if let Some((&older, Session { hello: Hello { incarnation, .. }, .. })) = older {
            if hello.incarnation <= *incarnation {
                return Err(Status::failed_precondition("this actor has connected anew since"));
            }
            self.order(older, Order::End(Status::failed_precondition("this actor has connected anew")));
            self.leave(older, "connected anew");
        }
        let returned = self.known.contains(&hello.actor);
        if self.known.len() < MAX_KNOWN_ACTORS {
            self.known.insert(hello.actor.clone());
        }
        let actor = self.free_name(&hello.actor);
        let what = if returned { "actor returned" } else { "actor joined" };
        info!(actor, slots = hello.slots, actors = self.sessions.len() + 1, "{what}");
        metrics::joined(returned);
        self.account.write(Entry::Joined { actor: &actor, returned });
        let newcomer = Session {
            actor,
            hello,
            orders,
            version: None,
            held: BTreeMap::new(),
            joined: Instant::now(),
            worked: None,
            episodes: 0,
            steps: 0,
        };
        self.sessions.insert(session, newcomer);
        self.count_actors();
        Ok(())
    }

    /// `name`, or with a number behind it where someone here has that name: in log and account, no two have the same.
    fn free_name(&self, name: &str) -> String {
        let taken: HashSet<&str> = self.sessions.values().map(|session| session.actor.as_str()).collect();
        let numbered = (2..).map(|number: u64| format!("{name}#{number}"));
        let mut names = std::iter::once(name.to_owned()).chain(numbered);
        names.find(|name| !taken.contains(name.as_str())).unwrap_or_default()
    }

    /// Tells a newcomer how things stand.
    fn greet(&mut self, session: u64) {
        if let Some((farewell, _)) = &self.finishing {
            self.order(session, farewell.order());
        } else if self.epoch.is_some() {
            self.announce(session);
        }
    }

    /// Tells a session of the open epoch, with the weights if it does not have them.
    fn announce(&mut self, id: u64) {
        let (Some(epoch), Some(session)) = (&self.epoch, self.sessions.get_mut(&id)) else { return };
        let version = epoch.weights.version;
        let weights = (session.version != Some(version)).then(|| epoch.weights.clone());
        session.version = Some(version);
        let order = Order::Open(OpenEpoch { epoch: epoch.number, version, weights });
        self.order(id, order);
    }

    /// Hands an order to a session. One that leaves its orders unread is dropped: nothing here waits.
    fn order(&mut self, id: u64, order: Order) {
        let Some(session) = self.sessions.get(&id) else { return };
        // One that has ended by itself says so itself.
        if let Err(TrySendError::Full(_)) = session.orders.try_send(order) {
            self.leave(id, "left its messages unread");
        }
    }

    fn order_all(&mut self, order: impl Fn(&Session) -> Option<Order>) {
        let orders: Vec<(u64, Order)> =
            self.sessions.iter().filter_map(|(&id, session)| Some((id, order(session)?))).collect();
        for (id, order) in orders {
            self.order(id, order);
        }
    }

    /// Forgets a session; its leases are free again.
    fn leave(&mut self, id: u64, reason: &str) {
        let Some(session) = self.sessions.remove(&id) else { return };
        self.count_actors();
        let leases = session.held.len();
        self.account.write(Entry::Left { actor: &session.actor, leases, reason });
        if self.finishing.is_some() {
            return;
        }
        if let Some(epoch) = &mut self.epoch {
            for index in session.held.keys() {
                epoch.holders.remove(index);
            }
            epoch.lost.extend(session.held.into_keys());
        }
        metrics::leases_lost(leases);
        let actors = self.sessions.len();
        info!(actor = session.actor, actors, "actor lost ({reason}); its {leases} leases are leased again");
    }

    fn count_actors(&self) {
        self.roster.set_count(self.sessions.len());
        metrics::actors(self.sessions.len());
    }

    /// Lets others see how the actors stand.
    fn show(&self) {
        let view = |session: &Session| ActorView {
            name: session.actor.clone(),
            slots: session.hello.slots,
            leases: session.held.len(),
            episodes: session.episodes,
            steps: session.steps,
            connected_seconds: session.joined.elapsed().as_secs_f64(),
            silent_seconds: session.worked.map(|(_, at)| at.elapsed().as_secs_f64()),
        };
        let actors: Vec<_> = self.sessions.values().map(view).collect();
        metrics::sampling(actors.iter().filter(|actor| actor.leases > 0).count());
        self.roster.set_actors(actors);
    }

    fn open(&mut self, epoch: u64, weights: WeightSet, target: Target) {
        for session in self.sessions.values_mut() {
            session.held.clear();
        }
        metrics::opened(epoch, weights.version);
        if self.account.turn_page() {
            for session in self.sessions.values() {
                self.account.write(Entry::Joined { actor: &session.actor, returned: true });
            }
        }
        self.account.write(Entry::Opened { epoch, version: weights.version, target });
        self.epoch = Some(Epoch {
            number: epoch,
            weights,
            target,
            opened: Instant::now(),
            patience: limits::LEASE_PATIENCE,
            next: 0,
            lost: BTreeSet::new(),
            holders: HashMap::new(),
            received: BTreeMap::new(),
            received_steps: 0,
            prefix: 0,
            prefix_steps: 0,
        });
        let sessions: Vec<u64> = self.sessions.keys().copied().collect();
        for session in sessions {
            self.announce(session);
        }
    }

    /// Keeps the episodes that are leased to this session; counts and drops the others.
    fn receive(&mut self, id: u64, EpisodeBatch { epoch: number, version, episodes }: EpisodeBatch) {
        let Some(session) = self.sessions.get_mut(&id) else { return };
        let actor = session.actor.as_str();
        let refuse = |account: &mut Account, reason, episodes: Vec<u64>| {
            metrics::refused(reason, episodes.len());
            account.write(Entry::Refused { epoch: number, version, actor, reason, episodes: ranges(episodes) });
        };
        let numbers = |episodes: &[Episode]| episodes.iter().map(|episode| episode.index).collect();
        let Some(epoch) = self.epoch.as_mut().filter(|epoch| epoch.number == number) else {
            return refuse(&mut self.account, "late", numbers(&episodes));
        };
        if version != epoch.weights.version {
            return refuse(&mut self.account, "version", numbers(&episodes));
        }
        // A duplicate is not held any more, so it is refused here too.
        let (mut accepted, mut unleased) = (Vec::new(), Vec::new());
        for episode in episodes {
            if session.held.remove(&episode.index).is_some() {
                metrics::accepted(episode.steps);
                session.episodes += 1;
                session.steps += episode.steps as u64;
                accepted.push(episode.index);
                self.length.see(episode.steps);
                epoch.accept(episode);
            } else {
                unleased.push(episode.index);
            }
        }
        if !accepted.is_empty() {
            session.worked = Some((number, Instant::now()));
            let episodes = ranges(accepted);
            self.account.write(Entry::Accepted { epoch: number, version, actor, episodes });
        }
        if !unleased.is_empty() {
            refuse(&mut self.account, "unleased", unleased);
        }
    }

    /// Where the prefix is a batch: hands it to the trainer, and calls off what is under way.
    fn close_if_complete(&mut self) {
        let Some(epoch) = self.epoch.take_if(|epoch| epoch.is_complete()) else { return };
        self.length = LengthEstimate::next_epoch(epoch.prefix_steps as f64 / epoch.prefix.max(1) as f64);
        let number = epoch.number;
        self.order_all(|session| (!session.held.is_empty()).then_some(Order::Close { epoch: number }));
        for session in self.sessions.values_mut() {
            session.held.clear();
        }
        let collected = epoch.into_collected();
        self.account.write(Entry::Closed {
            epoch: number,
            version: collected.version,
            episodes: collected.episodes.len() as u64,
            steps: collected.steps,
            surplus_episodes: collected.surplus_episodes,
        });
        // Before the trainer makes something of it.
        self.account.flush();
        // The trainer may be ending.
        let _ = self.results.send(collected);
    }

    /// Takes the leases of those who are too slow about them, where others who could work wait for nothing else.
    fn take_overdue(&mut self, now: Instant) {
        let Some(epoch) = &mut self.epoch else { return };
        // One that has never worked may be no better.
        let could_work = |session: &Session| {
            session.worked.is_some() || now.saturating_duration_since(session.joined) > epoch.patience
        };
        if !self.sessions.values().any(|session| session.held.is_empty() && could_work(session)) {
            return;
        }
        // What an actor sends now and then says nothing of how long all of it takes the others.
        let took = |session: &Session| {
            let (number, at) = session.worked?;
            (number == epoch.number).then(|| at.saturating_duration_since(epoch.opened))
        };
        let overdue: Vec<u64> = self
            .sessions
            .iter()
            .filter(|&(id, session)| {
                let Some(&oldest) = session.held.values().min() else { return false };
                let others = self.sessions.iter().filter(|&(other, _)| other != id);
                let usual = others.filter_map(|(_, other)| took(other)).max().unwrap_or_default();
                let patience = epoch.patience.max(limits::LEASE_PATIENCE_FACTOR * usual);
                now.saturating_duration_since(oldest) > patience
            })
            .map(|(&id, _)| id)
            .collect();
        if !overdue.is_empty() {
            // It may be the episode that takes so long, whoever samples it.
            epoch.patience *= 2;
        }
        for id in overdue {
            self.order(id, Order::Overdue);
            self.leave(id, "its leases are overdue");
        }
    }

    /// Leases what the batch still needs to whoever has room.
    fn lease(&mut self) {
        let Some(epoch) = &mut self.epoch else { return };
        let further = further_leases(epoch.target, epoch.progress(), self.length);
        // Lost leases count as outstanding, so what is further is beyond them.
        let count = further as usize + epoch.lost.len();
        if count == 0 {
            return;
        }
        let seats =
            self.sessions.iter().map(|(&session, s)| Seat { session, slots: s.hello.slots, held: s.held.len() });
        let mut leases: BTreeMap<u64, Vec<u64>> = BTreeMap::new();
        for session in assign(count, seats) {
            let index = epoch.lost.pop_first().unwrap_or_else(|| {
                epoch.next += 1;
                epoch.next - 1
            });
            epoch.holders.insert(index, session);
            leases.entry(session).or_default().push(index);
        }
        let number = epoch.number;
        let sessions = self.sessions.len();
        for (id, episodes) in leases {
            if let Some(session) = self.sessions.get_mut(&id) {
                let now = Instant::now();
                session.held.extend(episodes.iter().map(|&index| (index, now)));
                let episodes = ranges(episodes.iter().copied());
                self.account.write(Entry::Leased { epoch: number, actor: &session.actor, episodes });
            }
            self.order(id, Order::Lease(Leases { epoch: number, episodes }));
        }
        if self.sessions.len() < sessions {
            // One was dropped over this; what it held is free for the others. Ends, since each round has fewer.
            self.lease();
        }
    }
}

impl Epoch {
    fn progress(&self) -> Progress {
        Progress {
            received: self.received.len() as u64,
            received_steps: self.received_steps,
            outstanding: (self.holders.len() + self.lost.len()) as u64,
        }
    }

    fn accept(&mut self, episode: Episode) {
        self.holders.remove(&episode.index);
        self.received_steps += episode.steps as u64;
        self.received.insert(episode.index, episode);
        while !self.is_complete()
            && let Some(episode) = self.received.get(&self.prefix)
        {
            self.prefix_steps += episode.steps as u64;
            self.prefix += 1;
        }
    }

    fn is_complete(&self) -> bool {
        self.target.reached(self.prefix, self.prefix_steps)
    }

    fn into_collected(mut self) -> Collected {
        let surplus = self.received.split_off(&self.prefix);
        Collected {
            epoch: self.number,
            version: self.weights.version,
            steps: self.prefix_steps,
            episodes: self.received.into_values().collect(),
            surplus_episodes: surplus.len() as u64,
            surplus_steps: surplus.values().map(|episode| episode.steps as u64).sum(),
            seconds: self.opened.elapsed().as_secs_f64(),
        }
    }
}

#[cfg(test)]
mod tests;

//! The thread of libtorch: takes what the session hears, hands back episodes.

use std::time::Duration;

use popgym_envs::Registry;
use popgym_models::memory;
use popgym_proto::{ActorMessage, Episode, EpisodeBatch, Fingerprint, Leases, OpenEpoch, RunSpec, limits, wire};
use tokio::runtime::Runtime;
use tokio::sync::{mpsc, oneshot};
use tracing::info;

use crate::metrics::{self, Activity};
use crate::rollout::Rollout;

/// Commands that wait for the worker. It looks between two steps, milliseconds apart.
const COMMAND_QUEUE: usize = 64;

/// An idle worker says so this often.
const IDLE_INTERVAL: Duration = Duration::from_secs(1);

/// What the session tells the worker.
#[derive(Debug)]
pub enum Command {
    /// A session was welcomed: build what `spec` says, and answer with the fingerprint or with why not.
    Prepare {
        /// The run.
        spec: Box<RunSpec>,
        /// Where this session's output goes. It ends with the session.
        outputs: mpsc::Sender<Output>,
        /// The answer.
        reply: oneshot::Sender<anyhow::Result<Fingerprint>>,
    },
    /// Sampling of an epoch is open.
    Open(OpenEpoch),
    /// Episodes to sample.
    Lease(Leases),
    /// The epoch is complete.
    Close {
        /// The epoch.
        epoch: u64,
    },
    /// The session is lost, and with it its leases.
    Disconnected,
}

/// What the worker tells the session.
#[derive(Debug)]
pub enum Output {
    /// Send this.
    Message(wire::FromActor),
    /// This actor cannot work for this run.
    Failed(String),
}

/// A handle to the thread.
pub struct Worker {
    commands: mpsc::Sender<Command>,
    thread: std::thread::JoinHandle<()>,
}

impl Worker {
    /// Starts the thread.
    ///
    /// # Errors
    /// If the system refuses a thread.
    pub fn spawn(envs: Registry, memories: memory::Registry, slots: u32) -> std::io::Result<Self> {
        let (commands, inbox) = mpsc::channel(COMMAND_QUEUE);
        let clock = tokio::runtime::Builder::new_current_thread().enable_time().build()?;
        let thread = std::thread::Builder::new().name("rollout".to_owned()).spawn(move || {
            // One core an actor: more actors, not more threads. libtorch keeps this by thread, so it is set here.
            tch::set_num_threads(1);
            State { envs, memories, slots, rollout: None, outputs: None, finished: Vec::new() }.run(inbox, &clock);
        })?;
        Ok(Self { commands, thread })
    }

    /// Hands `command` over. False if the thread has died.
    pub async fn send(&self, command: Command) -> bool {
        self.commands.send(command).await.is_ok()
    }

    /// Resolves when the thread has died.
    pub async fn died(&self) {
        self.commands.closed().await;
    }

    /// Ends the thread after its present step, and waits for it.
    pub fn join(self) {
        drop(self.commands);
        // A panic there has been reported by the panic hook.
        let _ = self.thread.join();
    }
}

struct State {
    envs: Registry,
    memories: memory::Registry,
    slots: u32,
    rollout: Option<Rollout>,
    outputs: Option<mpsc::Sender<Output>>,
    finished: Vec<Episode>,
}

impl State {
    fn run(mut self, mut inbox: mpsc::Receiver<Command>, clock: &Runtime) {
        loop {
            while let Ok(command) = inbox.try_recv() {
                self.handle(command);
            }
            if self.step() {
                // Also the end of the handle: then there is nobody left to sample for.
                if inbox.is_closed() {
                    return;
                }
                continue;
            }
            let command = clock.block_on(async { tokio::time::timeout(IDLE_INTERVAL, inbox.recv()).await });
            if let Some(rollout) = &mut self.rollout {
                rollout.tally.lap(Activity::Idle);
            }
            match command {
                Ok(Some(command)) => self.handle(command),
                Ok(None) => return,
                Err(_) => {}
            }
        }
    }

    fn handle(&mut self, command: Command) {
        match command {
            Command::Prepare { spec, outputs, reply } => {
                let answer = self.prepare(*spec);
                self.outputs = answer.is_ok().then_some(outputs);
                // Nobody waits any more if the session has gone meanwhile.
                let _ = reply.send(answer);
            }
            Command::Open(OpenEpoch { epoch, version, weights }) => {
                let Some(rollout) = &mut self.rollout else { return };
                match rollout.open(epoch, version, weights.as_ref().map(|weights| &weights.bytes[..])) {
                    Ok(()) => metrics::opened(epoch, version),
                    Err(error) => self.send(Output::Failed(format!("epoch {epoch}: {error}"))),
                }
            }
            Command::Lease(Leases { epoch, episodes }) => {
                if let Some(rollout) = &mut self.rollout
                    && rollout.version().is_some()
                    && rollout.epoch() == epoch
                {
                    rollout.lease(episodes);
                }
            }
            Command::Close { epoch } => {
                if let Some(rollout) = &mut self.rollout
                    && rollout.epoch() == epoch
                {
                    rollout.drop_episodes();
                }
            }
            Command::Disconnected => {
                self.outputs = None;
                if let Some(rollout) = &mut self.rollout {
                    rollout.drop_episodes();
                }
            }
        }
    }

    /// Builds for `spec`, or keeps what was built for the same.
    fn prepare(&mut self, spec: RunSpec) -> anyhow::Result<Fingerprint> {
        if let Some(rollout) = &mut self.rollout
            && *rollout.spec() == spec
        {
            rollout.drop_episodes();
            return Ok(rollout.fingerprint());
        }
        info!(run = spec.run, env = spec.env, memory = spec.memory, seed = spec.seed, "working for");
        self.rollout = None;
        let rollout = self.rollout.insert(Rollout::new(&self.envs, &self.memories, spec, self.slots)?);
        Ok(rollout.fingerprint())
    }

    /// One step and its episodes sent; false if there is nothing to do.
    fn step(&mut self) -> bool {
        let Some(rollout) = self.rollout.as_mut().filter(|rollout| !rollout.is_idle()) else {
            if let Some(rollout) = &mut self.rollout {
                rollout.tally.flush(0, true);
            }
            return false;
        };
        if let Err(error) = rollout.step(&mut self.finished) {
            rollout.drop_episodes();
            self.finished.clear();
            self.send(Output::Failed(error.to_string()));
            return true;
        }
        if !self.finished.is_empty() {
            self.send_finished();
        }
        if let Some(rollout) = &mut self.rollout {
            rollout.tally.flush(rollout.live(), false);
        }
        true
    }

    /// All episodes that ended in this step, in one message, unless they are too large for that.
    fn send_finished(&mut self) {
        let Some(rollout) = &mut self.rollout else { return };
        let Some(version) = rollout.version() else { return };
        let (episodes, epoch) = (self.finished.len(), rollout.epoch());
        let bytes = self.finished.iter().map(Episode::wire_bytes).sum();
        for message in messages(epoch, version, &mut self.finished) {
            self.send(Output::Message(message));
        }
        if let Some(rollout) = &mut self.rollout {
            rollout.tally.sent(episodes, bytes);
            rollout.tally.lap(Activity::Sending);
        }
    }

    /// Waits while the network is behind. Without a session, what is sampled is void.
    fn send(&mut self, output: Output) {
        if let Some(outputs) = &self.outputs
            && outputs.blocking_send(output).is_err()
        {
            self.outputs = None;
            if let Some(rollout) = &mut self.rollout {
                rollout.drop_episodes();
            }
        }
    }
}

/// The messages that carry `finished` (which is left empty): usually one.
pub fn messages(epoch: u64, version: u64, finished: &mut Vec<Episode>) -> Vec<wire::FromActor> {
    let mut messages = Vec::with_capacity(1);
    let (mut episodes, mut bytes) = (Vec::with_capacity(finished.len()), 0);
    let mut close = |episodes: &mut Vec<Episode>| {
        if !episodes.is_empty() {
            let episodes = std::mem::take(episodes);
            messages.push(ActorMessage::Episodes(EpisodeBatch { epoch, version, episodes }).into_wire());
        }
    };
    for episode in finished.drain(..) {
        if bytes + episode.wire_bytes() > limits::EPISODES_MESSAGE_BYTES || episodes.len() == limits::MAX_EPISODES {
            close(&mut episodes);
            bytes = 0;
        }
        bytes += episode.wire_bytes();
        episodes.push(episode);
    }
    close(&mut episodes);
    messages
}

//! What training and evaluation share: the environment's specification, policies, the service for actors, and the local
//! actors, made from a configuration.

use std::net::TcpListener;
use std::path::Path;

use anyhow::Context;
use popgym_envs::{EnvSpec, Purpose, Space, stream};
use popgym_models::{Policy, PolicySpec, memory};
use popgym_proto::transport::metrics_address;
use popgym_proto::{EpisodeSpec, fingerprint, monitor};
use rand::Rng as _;
use tch::Device;

use crate::Extensions;
use crate::config::{self, Config, ServiceConfig};
use crate::local_actors::{ActorCommand, Hopeless, LocalActors};
use crate::page::{self, Board};
use crate::service::{Entrance, Service};

/// One learner at work, with its actors.
pub struct Session<'a> {
    config: &'a Config,
    env: EnvSpec,
    policy_spec: PolicySpec,
    memories: memory::Registry,
    device: Device,
    parameters: i64,
    /// Names and shapes of the policy's parameters.
    signature: String,
    /// Space of the actions that episodes store.
    stored_action: Space,
    /// How local actors are started where the configuration does not say it.
    actor_command: Vec<String>,
    /// The first is for remote actors; the second, if there is one, for local ones.
    entrances: Vec<Entrance>,
    /// What the page on the metrics port shows.
    board: Board,
    service: Option<Service>,
    actors: Option<LocalActors>,
}

impl<'a> Session<'a> {
    /// Prepares what `config` says; nothing is listening yet.
    ///
    /// # Errors
    /// An environment, memory or device that cannot be had.
    pub fn new(config: &'a Config, extensions: &Extensions) -> anyhow::Result<Self> {
        let device = popgym_models::device::parse(&config.device)?;
        popgym_models::device::set_threads(config.threads);
        let env = extensions.envs.get(&config.env)?.observed(config.observability)?;
        let policy_spec = config.policy_spec(&env);
        let policy = Policy::new(&policy_spec, &extensions.memories, Device::Cpu)?;
        Ok(Self {
            config,
            env,
            policy_spec,
            memories: extensions.memories.clone(),
            device,
            parameters: policy.parameters().values().map(|tensor| tensor.numel() as i64).sum(),
            signature: policy.signature(),
            stored_action: policy.distribution().stored_space(),
            actor_command: extensions.actor_command.clone(),
            entrances: Vec::new(),
            board: Board::default(),
            service: None,
            actors: None,
        })
    }

    /// The environment's specification.
    pub fn env(&self) -> &EnvSpec {
        &self.env
    }

    /// Number of trainable parameters.
    pub fn parameters(&self) -> i64 {
        self.parameters
    }

    /// A policy with fresh weights, drawn from libtorch's global generator.
    ///
    /// # Errors
    /// The policy cannot be built.
    pub fn policy(&self) -> anyhow::Result<Policy> {
        Ok(Policy::new(&self.policy_spec, &self.memories, self.device)?)
    }

    /// The run's first policy. Its weights are drawn on the CPU whatever the device, from libtorch's generator seeded with
    /// the run's stream of weights.
    ///
    /// # Errors
    /// The policy cannot be built.
    pub fn first_policy(&self) -> anyhow::Result<Policy> {
        let seed = stream(self.config.seed, 0, 0, Purpose::Weights).next_u64();
        tch::manual_seed((seed >> 1) as i64);
        let drawn = Policy::new(&self.policy_spec, &self.memories, Device::Cpu)?;
        if self.device == Device::Cpu {
            return Ok(drawn);
        }
        let mut policy = self.policy()?;
        policy.load(&drawn.to_bytes())?;
        Ok(policy)
    }

    /// Takes the addresses that the run needs, and looks for the program of the local actors; once.
    ///
    /// # Errors
    /// An address that cannot be had, or no such program.
    pub fn listen(&mut self) -> anyhow::Result<()> {
        if !self.entrances.is_empty() {
            return Ok(());
        }
        let service = &self.config.service;
        if service.actors > 0 {
            self.actor_command()?;
        }
        let listen = match (service.listen.as_str(), service.actors) {
            ("", 0) => "127.0.0.1:50051",
            ("", _) => "127.0.0.1:0",
            (address, _) => address,
        };
        let bind = |listen| TcpListener::bind(listen).with_context(|| format!("cannot listen for actors on {listen}"));
        let entrance = Entrance { listener: bind(listen)?, tls: service.tls() };
        check_exposure(&entrance, service)?;
        self.entrances.push(entrance);
        if service.tls().is_some() && service.actors > 0 {
            // Local actors need no certificate, and the learner's need not be for this machine's own address.
            self.entrances.push(Entrance { listener: bind("127.0.0.1:0")?, tls: None });
        }
        if service.metrics_listen.is_empty() { Ok(()) } else { self.monitor(&service.metrics_listen) }
    }

    /// Starts serving actors of the run called `run`, and starts the local ones. What happens is written to `account`.
    ///
    /// # Errors
    /// As [`Session::listen`], if that was not called before; or the actors cannot be started.
    pub fn serve(&mut self, run: &str, purpose: config::Purpose, account: Option<&Path>) -> anyhow::Result<()> {
        self.listen()?;
        let entrances = std::mem::take(&mut self.entrances);
        let local = entrances.last().context("no listening address")?.listener.local_addr()?;
        let spec = self.config.run_spec(run, purpose)?;
        let episodes = EpisodeSpec {
            observation: self.env.observation.clone(),
            action: self.stored_action.clone(),
            max_steps: self.env.max_steps.min(self.config.max_episode_steps),
        };
        let fingerprint = fingerprint(&spec, &format!("{:?}", self.env), &self.signature);
        let service = &self.config.service;
        let started = Service::start(entrances, service.token(), account, spec, episodes, fingerprint)?;
        self.board.set_roster(started.roster());
        self.service = Some(started);
        if service.actors > 0 {
            let mut args = vec![
                "--learner".to_owned(),
                format!("http://{local}"),
                "--run".to_owned(),
                run.to_owned(),
                "--slots".to_owned(),
                service.slots.to_string(),
            ];
            if !service.token_file.is_empty() {
                args.extend(["--token-file".to_owned(), service.token_file.clone()]);
            }
            if self.config.lag == 1 {
                // They sample while the learner learns on the same cores: they get what it leaves.
                args.extend(["--nice".to_owned(), "19".to_owned()]);
            }
            self.actors = Some(LocalActors::spawn(service.actors as usize, self.actor_command()?.with(args))?);
        } else {
            let scheme = if service.tls().is_some() { "https" } else { "http" };
            tracing::info!("waiting for actors: actor --learner {scheme}://{local}");
        }
        Ok(())
    }

    /// What the page on the metrics port shows; an observer of the run.
    pub fn board(&self) -> Board {
        self.board.clone()
    }

    fn monitor(&self, address: &str) -> anyhow::Result<()> {
        let address = metrics_address(address).map_err(anyhow::Error::msg)?;
        self.board.set_config(self.config.to_toml()?);
        monitor::serve(address, page::router(self.board())).map_err(anyhow::Error::msg)?;
        crate::observer::Prometheus::describe();
        tracing::info!("the run's page: http://{address}/");
        Ok(())
    }

    fn actor_command(&self) -> anyhow::Result<ActorCommand> {
        let given = &self.config.service.actor_command;
        ActorCommand::find(if given.is_empty() { &self.actor_command } else { given })
    }

    /// Tells when the local actors fail again and again.
    pub fn hopeless(&self) -> Hopeless {
        self.actors.as_ref().map(LocalActors::hopeless).unwrap_or_default()
    }

    /// The service for actors.
    ///
    /// # Errors
    /// [`Session::serve`] was not called.
    pub fn service(&self) -> anyhow::Result<&Service> {
        self.service.as_ref().context("the service has not been started")
    }

    /// Ends the service and the local actors. With a `reason` all actors are told that the run is complete; without one
    /// remote actors wait for the learner's return.
    pub fn end(self, reason: Option<&str>) {
        match (self.service, reason) {
            (Some(service), Some(reason)) => service.finish(reason),
            (Some(service), None) => service.pause(),
            (None, _) => {}
        }
        if let Some(actors) = self.actors {
            actors.stop();
        }
    }
}

/// Refuses to let strangers in by accident.
fn check_exposure(entrance: &Entrance, service: &ServiceConfig) -> anyhow::Result<()> {
    let address = entrance.listener.local_addr()?;
    if address.ip().to_canonical().is_loopback() || (entrance.tls.is_some() && !service.token_file.is_empty()) {
        return Ok(());
    }
    anyhow::ensure!(
        service.insecure,
        "service.listen is `{}`, which other machines reach: allowed with tls_certificate, tls_key and token_file, or with \
         `insecure` on a network whose every user you trust",
        service.listen
    );
    tracing::warn!(
        "listening on {address} without TLS or without a token: whoever reaches it can read and change this run"
    );
    Ok(())
}

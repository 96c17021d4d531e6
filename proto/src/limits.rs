//! Every limit of the wire: sizes, deadlines, windows, queues.
//!
//! Both sides use the same numbers. A size limit is checked where a message becomes a domain type; a deadline where a
//! session waits.

use std::time::Duration;

/// How often something may happen.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rate {
    /// So many times at once.
    pub burst: u32,
    /// So many times a second in the long run.
    pub per_second: u32,
}

/// Largest encoded message, both to send and to receive, in bytes. A learner takes none that is larger than its run's
/// episodes need ([`crate::EpisodeSpec::largest_message`]).
///
/// Weights are 1 to 3 MB (GRU-256: 0.5 M parameters x 4 B = 2 MB); the largest memories reach some 20 MB. An episode of
/// [`MAX_EPISODE_STEPS`] steps with 100 reals to see is 65,536 x (4 x 100 + 13) B = 27 MB.
pub const MAX_MESSAGE_BYTES: usize = 64 << 20;

/// Room kept for what surrounds weights or an episode in its message, in bytes: tags, lengths, indices.
pub const MESSAGE_OVERHEAD_BYTES: usize = 1024;

/// What surrounds the columns of an episode in its message, in bytes, at most: ten tags of one byte, eight lengths of up to
/// five, an index of up to ten.
pub const EPISODE_OVERHEAD_BYTES: usize = 64;

/// Episodes that end together travel together up to about this many bytes; then a further message starts.
///
/// 4,096 episodes of 51 steps at 15 B a step are 3 MB, so this splits only where episodes are large.
pub const EPISODES_MESSAGE_BYTES: usize = 4 << 20;

/// Most episodes that an actor steps at a time.
///
/// One libtorch thread is saturated by a few hundred rows; beyond, episodes only get later.
pub const MAX_SLOTS: u32 = 4096;

/// Fewest rows in a batch of inference.
///
/// From here up, a row's result does not depend on the number of rows (measured with libtorch 2.11 on an AVX-512 CPU);
/// below, it differs in the last bits.
pub const MIN_ROWS: u32 = 16;

/// Longest episode, in steps. The longest of the benchmark has 1,024.
pub const MAX_EPISODE_STEPS: u32 = 65_536;

/// Most leases in one message, and most that one actor holds: all its slots, and as many again waiting.
pub const MAX_LEASES: usize = 2 * MAX_SLOTS as usize;

/// Most episodes in one message: all slots may end in the same step.
pub const MAX_EPISODES: usize = MAX_SLOTS as usize;

/// Longest name (run, actor, environment, memory, build), in characters.
pub const MAX_NAME_CHARS: usize = 128;

/// Longest table of options, as TOML, in bytes.
pub const MAX_OPTIONS_BYTES: usize = 64 << 10;

/// Longest reason for a stop or a refusal, in characters. A gRPC status travels in HTTP/2 headers: 1,024 characters of up
/// to 4 bytes, percent-encoded to 3 bytes each, are 12 KiB, within [`MAX_HEADER_LIST_BYTES`].
pub const MAX_REASON_CHARS: usize = 1024;

/// Most actors of one learner.
pub const MAX_SESSIONS: usize = 1024;

/// Most connections of one learner: all actors, and as many again that come and go or only ask for its health.
pub const MAX_CONNECTIONS: usize = 2 * MAX_SESSIONS;

/// Most connections from one address whose actor is not ready. They are dropped after [`HELLO_DEADLINE`], or after
/// [`READY_DEADLINE`] where they have said a legal hello.
pub const MAX_STRANGERS: usize = 256;

/// Connections of one address, and requests beyond the first of each. All of [`MAX_SESSIONS`] may be behind one address, and
/// come back four times in a few minutes.
pub const ATTEMPTS: Rate = Rate { burst: 4 * MAX_SESSIONS as u32, per_second: 4 };

/// What a session that broke a rule costs of its address's [`ATTEMPTS`]. No honest actor ever does, so this is for liars:
/// 64 at once, then one in 16 s.
pub const OFFENCE_ATTEMPTS: u32 = 64;

/// Bytes that a connection may carry before its actor is ready: one list of headers ([`MAX_HEADER_LIST_BYTES`]), a hello of
/// 2 KiB, and some to spare. Afterwards, as many beyond its longest message and [`WINDOW_BYTES`] that are under way.
pub const STRANGER_BYTES: usize = 64 << 10;

/// Heartbeats of a session. One is sent every [`HEARTBEAT_INTERVAL`]; a network that stood still for [`SILENCE_LIMIT`]
/// delivers four at once.
pub const HEARTBEATS: Rate = Rate { burst: 16, per_second: 1 };

/// Bytes of HTTP/2 (pings, acknowledgements, windows) that a connection may carry for each message of its actor. Between two
/// heartbeats there are some 100.
pub const OVERHEAD_BYTES: usize = 16 << 10;

/// Connections to a metrics port at a time; more wait. Prometheus has one, a browser six.
pub const MONITOR_CONNECTIONS: usize = 64;

/// A connection to a metrics port is closed after this long, whatever it does; the next request makes a new one.
pub const MONITOR_CONNECTION_AGE: Duration = Duration::from_mins(5);

/// A peer whose TLS handshake takes longer is dropped.
pub const TLS_DEADLINE: Duration = Duration::from_secs(5);

/// A TCP connection that is not there after this long has failed.
pub const CONNECT_DEADLINE: Duration = Duration::from_secs(5);

/// An actor that connects says hello within this; a learner answers within this.
pub const HELLO_DEADLINE: Duration = Duration::from_secs(10);

/// An actor that was welcomed is ready within this: it builds environments and policy (a second; more on a busy machine).
pub const READY_DEADLINE: Duration = Duration::from_mins(2);

/// Each side sends something at least this often.
pub const HEARTBEAT_INTERVAL: Duration = Duration::from_secs(5);

/// A peer that sent nothing for this long is gone: four heartbeats. So is one that takes nothing of what it is sent.
pub const SILENCE_LIMIT: Duration = Duration::from_secs(20);

/// A peer that sends, or takes, as many bytes within [`SILENCE_LIMIT`] is not gone, but slow: a long message is on its way.
pub const SLOWEST_BYTES: u64 = 64 << 10;

/// An actor waits as long for the learner's next message, of up to [`MAX_MESSAGE_BYTES`], while the network is alive
/// ([`KEEPALIVE_TIMEOUT`]): weights of 20 MB for 256 actors take 41 s of 1 Gbit/s.
pub const MESSAGE_DEADLINE: Duration = Duration::from_mins(5);

/// An actor that holds leases and has sent nothing for this long, and for [`LEASE_PATIENCE_FACTOR`] times as long as others of
/// the epoch took for all of theirs, keeps idle actors waiting: they get its leases. Each time within an epoch, it takes twice
/// as long. The longest episodes of the benchmark (1,024 steps, of some ms each when few are left) take seconds.
pub const LEASE_PATIENCE: Duration = Duration::from_mins(5);

/// See [`LEASE_PATIENCE`]. Slower machines than that are no help.
pub const LEASE_PATIENCE_FACTOR: u32 = 4;

/// HTTP/2 pings, both sides: every 10 s, also on an idle connection. Peers that do not answer within
/// [`KEEPALIVE_TIMEOUT`] are gone. Together 20 s, as for heartbeats; the latter also notice a process that hangs.
pub const KEEPALIVE_INTERVAL: Duration = Duration::from_secs(10);

/// See [`KEEPALIVE_INTERVAL`].
pub const KEEPALIVE_TIMEOUT: Duration = Duration::from_secs(10);

/// A learner that ends waits this long for its actors to take their leave.
pub const FINISH_DEADLINE: Duration = Duration::from_secs(5);

/// Then its connections have this long to be closed.
pub const CLOSE_DEADLINE: Duration = Duration::from_millis(500);

/// HTTP/2 flow-control windows, of a stream and of a connection, in bytes.
///
/// One session a connection, so both are equal. A window of 16 MiB keeps a 1 Gbit/s link with 100 ms round trip full
/// (12.5 MB in flight), and holds any usual weights message whole.
pub const WINDOW_BYTES: u32 = 16 << 20;

/// Largest HTTP/2 frame that an actor takes: weights travel in few of them, not in hundreds of 16 KiB each. One that takes
/// longer than [`KEEPALIVE_INTERVAL`] and [`KEEPALIVE_TIMEOUT`] to come would end the connection: 13 KB/s is enough.
pub const FRAME_BYTES: u32 = 256 << 10;

/// Most concurrent streams of a connection: a session, health checks, and some to spare.
pub const MAX_STREAMS_PER_CONNECTION: u32 = 8;

/// Most streams of a connection that were reset and not yet cleaned up ("rapid reset"), by the peer or over its errors.
pub const MAX_PENDING_RESET_STREAMS: usize = 16;

/// Largest HTTP/2 header list, in bytes.
pub const MAX_HEADER_LIST_BYTES: u32 = 16 << 10;

/// Messages waiting to be written to one stream, before gRPC takes them. Small: HTTP/2 buffers too.
pub const STREAM_QUEUE: usize = 4;

/// Decisions waiting for one session (epochs, leases). An actor that leaves more unread than this is dropped: at some ten
/// a second, this is a silence of six seconds.
pub const SESSION_QUEUE: usize = 64;

/// Events of all sessions waiting for the coordinator; sessions wait when it is full, and with them their actors.
pub const COORDINATOR_QUEUE: usize = 256;

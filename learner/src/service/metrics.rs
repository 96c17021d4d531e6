//! What Prometheus sees of the service. All names start with `popgym_learner_`.

use metrics::{counter, describe_counter, describe_gauge, gauge};

/// Why connections and requests are refused.
const CONNECTION_REASONS: [&str; 7] = ["full", "rate", "tls", "http2", "token", "deadline", "flood"];

/// Why sessions are refused or ended.
const SESSION_REASONS: [&str; 9] =
    ["full", "second", "handshake", "silent", "unread", "overdue", "illegal", "heartbeats", "excess"];

/// Why episodes are refused, and messages.
const EPISODE_REASONS: [&str; 9] =
    ["late", "unleased", "version", "excess", "missing", "value", "length", "element", "encoding"];

/// Names and explains every metric of the service. What is rare is 0 from the start: Prometheus sees no increase from nothing
/// to 1.
pub(super) fn describe() {
    describe_gauge!("popgym_learner_actors", "Actors that are connected and ready");
    describe_gauge!("popgym_learner_actors_sampling", "Of these, actors that hold leases");
    describe_gauge!("popgym_learner_connections", "TCP connections, of actors and others");
    describe_counter!(
        "popgym_learner_connections_refused_total",
        "Connections and requests refused, by reason: full, rate (too often), tls, http2 (another protocol), token, \
         deadline (no hello in time), flood (bytes without use)"
    );
    describe_counter!(
        "popgym_learner_account_failures_total",
        "Times that events.jsonl could not be written, and ended"
    );
    describe_gauge!("popgym_learner_open_epoch", "Epoch that is being sampled");
    describe_gauge!("popgym_learner_sampling_version", "Version of the weights that sample it");
    describe_gauge!("popgym_learner_lag_epochs", "Open epoch minus the version that samples it");
    describe_counter!("popgym_learner_sessions_total", "Sessions that got as far as being ready");
    describe_counter!("popgym_learner_reconnects_total", "Sessions of actors that had been here before");
    describe_counter!(
        "popgym_learner_sessions_refused_total",
        "Sessions refused or ended, by reason: full, second (of one connection), handshake, silent, unread, \
         overdue (leases), illegal, heartbeats (too many), excess (more episodes than leases)"
    );
    describe_counter!("popgym_learner_leases_lost_total", "Leases of actors that went away; they are leased again");
    describe_counter!("popgym_learner_episodes_accepted_total", "Episodes received and wanted");
    describe_counter!(
        "popgym_learner_steps_accepted_total",
        "Their environment steps, those of surplus episodes included"
    );
    describe_counter!(
        "popgym_learner_episodes_refused_total",
        "Episodes received and dropped, by reason: late, unleased, version, excess; and messages by what was illegal: \
         missing, value, length, element, encoding"
    );
    describe_counter!("popgym_learner_received_bytes_total", "Bytes of the columns of episodes received");
    describe_counter!("popgym_learner_sent_bytes_total", "Bytes of weights sent");
    describe_gauge!("popgym_learner_event_queue", "Events of sessions that wait for the coordinator");
    describe_gauge!("popgym_learner_leases_outstanding", "Episodes leased and not received");

    for reason in CONNECTION_REASONS {
        counter!("popgym_learner_connections_refused_total", "reason" => reason).increment(0);
    }
    for reason in SESSION_REASONS {
        counter!("popgym_learner_sessions_refused_total", "reason" => reason).increment(0);
    }
    for reason in EPISODE_REASONS {
        refused(reason, 0);
    }
    leases_lost(0);
    counter!("popgym_learner_account_failures_total").increment(0);
    counter!("popgym_learner_reconnects_total").increment(0);
    counter!("popgym_learner_episodes_accepted_total").increment(0);
    counter!("popgym_learner_steps_accepted_total").increment(0);
}

pub(super) fn actors(count: usize) {
    gauge!("popgym_learner_actors").set(count as f64);
}

pub(super) fn sampling(count: usize) {
    gauge!("popgym_learner_actors_sampling").set(count as f64);
}

pub(super) fn connections(count: usize) {
    gauge!("popgym_learner_connections").set(count as f64);
}

pub(super) fn connection_refused(reason: &'static str) {
    debug_assert!(CONNECTION_REASONS.contains(&reason), "{reason}");
    counter!("popgym_learner_connections_refused_total", "reason" => reason).increment(1);
}

pub(super) fn account_failed() {
    counter!("popgym_learner_account_failures_total").increment(1);
}

pub(super) fn opened(epoch: u64, version: u64) {
    gauge!("popgym_learner_open_epoch").set(epoch as f64);
    gauge!("popgym_learner_sampling_version").set(version as f64);
    gauge!("popgym_learner_lag_epochs").set(epoch as f64 - version as f64);
}

pub(super) fn joined(returned: bool) {
    counter!("popgym_learner_sessions_total").increment(1);
    if returned {
        counter!("popgym_learner_reconnects_total").increment(1);
    }
}

pub(super) fn session_refused(reason: &'static str) {
    debug_assert!(SESSION_REASONS.contains(&reason), "{reason}");
    counter!("popgym_learner_sessions_refused_total", "reason" => reason).increment(1);
}

pub(super) fn leases_lost(count: usize) {
    counter!("popgym_learner_leases_lost_total").increment(count as u64);
}

pub(super) fn accepted(steps: usize) {
    counter!("popgym_learner_episodes_accepted_total").increment(1);
    counter!("popgym_learner_steps_accepted_total").increment(steps as u64);
}

pub(super) fn refused(reason: &'static str, episodes: usize) {
    debug_assert!(EPISODE_REASONS.contains(&reason), "{reason}");
    counter!("popgym_learner_episodes_refused_total", "reason" => reason).increment(episodes as u64);
}

pub(super) fn received(bytes: usize) {
    counter!("popgym_learner_received_bytes_total").increment(bytes as u64);
}

pub(super) fn sent(bytes: usize) {
    counter!("popgym_learner_sent_bytes_total").increment(bytes as u64);
}

pub(super) fn queues(events: usize, leases: usize) {
    gauge!("popgym_learner_event_queue").set(events as f64);
    gauge!("popgym_learner_leases_outstanding").set(leases as f64);
}

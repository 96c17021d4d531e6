//! The command line.

use std::net::{IpAddr, SocketAddr};
use std::path::PathBuf;

use popgym_proto::{error, limits, transport};

/// Steps environments and streams episodes to a learner.
///
/// Exit codes: 0 the run is complete, 1 failure (the reason in one line), 2 wrong usage.
#[derive(Clone, Debug, clap::Parser)]
#[command(name = "actor", version)]
pub struct Args {
    /// Where the learner listens, for example http://gpu-box:5555; https:// where it has TLS
    #[arg(long, env = "POPGYM_LEARNER", value_name = "URL", value_parser = learner_url)]
    pub learner: String,

    /// File of the token that the learner wants to see
    #[arg(long, env = "POPGYM_TOKEN_FILE", value_name = "FILE")]
    pub token_file: Option<PathBuf>,

    /// Show the token even where the network can read it, to http:// on another machine
    #[arg(long, env = "POPGYM_INSECURE")]
    pub insecure: bool,

    /// File of the CA that signed the learner's certificate, PEM; needed for https://
    #[arg(long, env = "POPGYM_TLS_CA", value_name = "FILE")]
    pub tls_ca: Option<PathBuf>,

    /// File of this actor's own certificate, PEM, where the learner wants one
    #[arg(long, env = "POPGYM_TLS_CERTIFICATE", value_name = "FILE", requires = "tls_key")]
    pub tls_certificate: Option<PathBuf>,

    /// File of its private key, PEM
    #[arg(long, env = "POPGYM_TLS_KEY", value_name = "FILE", requires = "tls_certificate")]
    pub tls_key: Option<PathBuf>,

    /// Episodes stepped at a time, on one core
    #[arg(long, env = "POPGYM_SLOTS", value_name = "N", default_value_t = 128, value_parser = clap::value_parser!(u32).range(1..=i64::from(limits::MAX_SLOTS)))]
    pub slots: u32,

    /// Name of this actor in the learner's log; host name and process id if not given
    #[arg(long, env = "POPGYM_ACTOR_NAME", value_parser = name)]
    pub name: Option<String>,

    /// Work for this run only: a learner of another run is refused
    #[arg(long, env = "POPGYM_RUN", value_name = "ID", value_parser = name)]
    pub run: Option<String>,

    /// Serve Prometheus metrics here: PORT, for this machine alone, or IP:PORT; off if not given
    #[arg(long, env = "POPGYM_ACTOR_METRICS_LISTEN", value_name = "ADDR", value_parser = transport::metrics_address)]
    pub metrics_listen: Option<SocketAddr>,

    /// Give up when there has been no learner for this long, a year at most
    #[arg(long, env = "POPGYM_RETRY_SECONDS", value_name = "S", default_value_t = 300, value_parser = clap::value_parser!(u64).range(..=31_536_000))]
    pub retry_seconds: u64,

    /// End when standard input ends: with the process that started this one
    #[arg(long)]
    pub with_parent: bool,

    /// Lower this process's priority: 0 (not at all) to 19 (runs when nothing else does)
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(i32).range(0..=19))]
    pub nice: i32,
}

impl Args {
    /// Checks what the flags must be together.
    ///
    /// # Errors
    /// The flag that is missing or has no use.
    pub fn validate(&self) -> Result<(), String> {
        if self.token_file.is_some() && !self.insecure && is_readable(&self.learner) {
            return Err(format!(
                "--learner is {}, where whoever is on the way reads the token: allowed with --token-file is https://HOST:PORT, \
                 or --insecure on a network whose every user you trust",
                self.learner
            ));
        }
        match (self.learner.starts_with("https://"), &self.tls_ca) {
            (true, None) => Err(format!(
                "--learner is {}, which needs --tls-ca: the file of the CA that signed the learner's certificate",
                self.learner
            )),
            (false, _) if self.tls_ca.is_some() || self.tls_certificate.is_some() => Err(format!(
                "--learner is {}, allowed with --tls-ca or --tls-certificate is https://HOST:PORT",
                self.learner
            )),
            _ => Ok(()),
        }
    }
}

/// A URL, `http://` added where no scheme is given.
fn learner_url(text: &str) -> Result<String, String> {
    let url = if text.contains("://") { text.to_owned() } else { format!("http://{text}") };
    if !url.starts_with("http://") && !url.starts_with("https://") {
        return Err("expected http://HOST:PORT or https://HOST:PORT".to_owned());
    }
    let endpoint =
        transport::endpoint(&url).map_err(|_| "expected http://HOST:PORT or https://HOST:PORT".to_owned())?;
    match endpoint.uri().port() {
        Some(_) => Ok(url),
        None => Err("the port is missing: expected http://HOST:PORT or https://HOST:PORT".to_owned()),
    }
}

/// Whether what is sent to this learner can be read by others on the way: no TLS, and not this machine.
fn is_readable(url: &str) -> bool {
    let Some(host) = url.strip_prefix("http://") else { return false };
    let host = host.rsplit_once(':').map_or(host, |(host, _)| host);
    let address: Option<IpAddr> = host.trim_matches(['[', ']']).parse().ok();
    host != "localhost" && !address.is_some_and(|address| address.to_canonical().is_loopback())
}

fn name(text: &str) -> Result<String, String> {
    error::name("the name", text.to_owned(), 1).map_err(|error| error.to_string())
}

#[cfg(test)]
mod tests {
    use clap::{CommandFactory as _, Parser as _};

    use super::*;

    fn parse(args: &[&str]) -> Result<Args, clap::Error> {
        Args::try_parse_from(["actor"].iter().chain(args))
    }

    #[test]
    fn the_command_line_is_consistent() {
        Args::command().debug_assert();
    }

    #[test]
    fn a_learner_is_an_http_url_with_a_port() {
        assert_eq!(parse(&["--learner", "box:5555"]).unwrap().learner, "http://box:5555");
        assert_eq!(parse(&["--learner", "http://[::1]:5555"]).unwrap().learner, "http://[::1]:5555");
        assert_eq!(parse(&["--learner", "https://box:5555"]).unwrap().learner, "https://box:5555");
        for wrong in ["ftp://box:5555", "http://box", "https://box", "http://b x:1", ""] {
            assert_eq!(parse(&["--learner", wrong]).unwrap_err().exit_code(), 2, "{wrong}");
        }
    }

    #[test]
    fn tls_and_its_files_go_together() {
        let valid = |args: &[&str]| parse(args).unwrap().validate();
        assert_eq!(valid(&["--learner", "https://box:5555", "--tls-ca", "ca.pem"]), Ok(()));
        assert!(valid(&["--learner", "https://box:5555"]).unwrap_err().contains("needs --tls-ca"));
        assert!(
            valid(&["--learner", "http://box:5555", "--tls-ca", "ca.pem"]).unwrap_err().contains("https://HOST:PORT")
        );
        assert!(parse(&["--learner", "https://box:5555", "--tls-ca", "a", "--tls-key", "b"]).is_err());
    }

    #[test]
    fn a_token_is_shown_to_nobody_on_the_way() {
        let valid = |learner: &str, more: &[&str]| {
            parse(&[&["--learner", learner, "--token-file", "token"], more].concat()).unwrap().validate()
        };
        for own in ["localhost:1", "127.0.0.1:1", "http://[::1]:1", "127.8.8.8:1"] {
            assert_eq!(valid(own, &[]), Ok(()), "{own}");
        }
        assert_eq!(valid("https://box:1", &["--tls-ca", "ca.pem"]), Ok(()));
        for far in ["box:1", "http://10.0.0.1:1", "[2001:db8::1]:1", "localhost.example.org:1", "0.0.0.0:1"] {
            assert!(valid(far, &[]).unwrap_err().contains("--insecure"), "{far}");
            assert_eq!(valid(far, &["--insecure"]), Ok(()), "{far}");
        }
    }

    #[test]
    fn numbers_have_limits() {
        for wrong in [
            ["--slots", "0"],
            ["--slots", "4097"],
            ["--nice", "20"],
            ["--name", "a b"],
            ["--name", "a\u{200b}b"],
            ["--run", ""],
            ["--retry-seconds", "31536001"],
        ] {
            assert!(parse(&["--learner", "a:1", wrong[0], wrong[1]]).is_err(), "{wrong:?}");
        }
    }
}

//! The token: a secret that the learner and its actors share, each from a file of its own.

use std::fmt;
use std::path::Path;

use sha2::{Digest as _, Sha256};
use subtle::ConstantTimeEq as _;
use tonic::metadata::{Ascii, MetadataMap, MetadataValue};

/// Where a token travels.
const HEADER: &str = "authorization";

/// Characters of a token: 16 random ones cannot be guessed, more than 1,024 do not fit a header.
const CHARACTERS: std::ops::RangeInclusive<usize> = 16..=1024;

/// A secret. Nothing but a request's header ever shows it.
#[derive(Clone)]
pub struct Token {
    header: MetadataValue<Ascii>,
    digest: [u8; 32],
}

impl fmt::Debug for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Token(..)")
    }
}

impl Token {
    /// The token in a file, without the white space around it.
    ///
    /// # Errors
    /// The file cannot be read, or what it holds is no token: 16 to 1,024 visible ASCII characters. What it holds is not told.
    pub fn read(path: &Path) -> Result<Self, String> {
        let wrong = |problem: String| format!("the token file {} {problem}", path.display());
        let text = std::fs::read_to_string(path).map_err(|error| wrong(format!("cannot be read: {error}")))?;
        let token = text.trim();
        let visible = token.bytes().all(|byte| byte.is_ascii_graphic());
        let header = format!("Bearer {token}").parse::<MetadataValue<Ascii>>().ok();
        let Some(mut header) = header.filter(|_| visible && CHARACTERS.contains(&token.len())) else {
            let (least, most) = CHARACTERS.into_inner();
            return Err(wrong(format!(
                "holds {} bytes, allowed is one word of {least} to {most} visible ASCII characters",
                token.len()
            )));
        };
        header.set_sensitive(true);
        let digest = digest(&header);
        Ok(Self { header, digest })
    }

    /// Puts the token into a request's headers.
    pub fn put(&self, headers: &mut MetadataMap) {
        headers.insert(HEADER, self.header.clone());
    }

    /// Whether a request's headers have this token. How long that takes tells nothing about the token.
    pub fn is_in(&self, headers: &MetadataMap) -> bool {
        headers.get(HEADER).is_some_and(|given| bool::from(digest(given).ct_eq(&self.digest)))
    }
}

fn digest(header: &MetadataValue<Ascii>) -> [u8; 32] {
    Sha256::digest(header.as_encoded_bytes()).into()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(name: &str, text: &str) -> Result<Token, String> {
        let path = std::env::temp_dir().join(format!("popgym-token-{}-{name}", std::process::id()));
        std::fs::write(&path, text).unwrap();
        let token = Token::read(&path);
        std::fs::remove_file(path).unwrap();
        token
    }

    #[test]
    fn a_token_is_recognised_and_no_other() {
        let token = read("right", "  0123456789abcdef\n").unwrap();
        let mut headers = MetadataMap::new();
        assert!(!token.is_in(&headers));
        token.put(&mut headers);
        assert!(token.is_in(&headers));
        assert_eq!(headers.get("authorization").unwrap(), "Bearer 0123456789abcdef");
        for other in ["0123456789abcdeF", "0123456789abcde0f", "0123456789abcdef0"] {
            read("other", other).unwrap().put(&mut headers);
            assert!(!token.is_in(&headers), "{other}");
        }
        headers.insert("authorization", "0123456789abcdef".parse().unwrap());
        assert!(!token.is_in(&headers), "not as a bearer's");
    }

    #[test]
    fn a_token_is_never_shown() {
        let token = read("shown", "0123456789abcdef").unwrap();
        let mut headers = MetadataMap::new();
        token.put(&mut headers);
        assert!(!format!("{token:?} {headers:?}").contains("0123"));
    }

    #[test]
    fn what_is_no_token_is_refused_without_a_word_of_it() {
        for wrong in
            ["", "hunter2", "0123456789 abcdef", "0123456789abcdeé", &"x".repeat(1025), "0123456789\u{7}abcdef"]
        {
            let error = read("wrong", wrong).unwrap_err();
            assert!(error.contains("allowed is one word of 16 to 1024"), "{error}");
            assert!(wrong.is_empty() || !error.contains(wrong), "{error}");
        }
        let error = Token::read(Path::new("no/such/file")).unwrap_err();
        assert!(error.contains("no/such/file cannot be read"), "{error}");
    }
}

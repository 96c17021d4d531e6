//! The learner's own page, on its metrics port: the curve, how fast, where time goes, who is here, the configuration.
//!
//! One self-contained file, which asks for `/run.json` every two seconds.

use std::path::Path;

use axum::Router;
use axum::extract::{Path as Name, Request, State};
use axum::http::{StatusCode, header};
use axum::response::{Html, IntoResponse, Json, Response};
use axum::routing::get;
use tower_http::services::ServeFile;

mod board;

pub use board::Board;

/// What may be read of the run directory. Checkpoints are left to those who have the directory.
const FILES: [&str; 7] =
    ["config.toml", "metrics.csv", "timing.csv", "summary.json", "curve.svg", "curve.png", "events.jsonl"];

/// The page may load nothing and run nothing but what it brings.
const POLICY: &str = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; connect-src 'self'; \
                      img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// The page and what it asks for.
pub fn router(board: Board) -> Router {
    let page = [(header::CONTENT_SECURITY_POLICY, POLICY)];
    Router::new()
        .route("/", get((page, Html(include_str!("page.html")))))
        .route("/run.json", get(data))
        .route("/files/{name}", get(file))
        .with_state(board)
}

async fn data(State(board): State<Board>) -> Response {
    // A disk that hangs must not keep the port from all else.
    let dir = board.dir();
    let files = tokio::task::spawn_blocking(move || dir.map_or(Vec::new(), |dir| files_in(&dir)));
    Json(board.view(files.await.unwrap_or_default())).into_response()
}

/// Those of [`FILES`] that there are.
fn files_in(dir: &Path) -> Vec<&'static str> {
    FILES.into_iter().filter(|name| dir.join(name).is_file()).collect()
}

async fn file(State(board): State<Board>, Name(name): Name<String>, request: Request) -> Response {
    let listed = FILES.into_iter().find(|&file| file == name);
    let (Some(dir), Some(file)) = (board.dir(), listed) else {
        return (StatusCode::NOT_FOUND, format!("no such file; there are {}\n", FILES.join(", "))).into_response();
    };
    match ServeFile::new(dir.join(file)).try_call(request).await {
        Ok(response) => ([(header::X_CONTENT_TYPE_OPTIONS, "nosniff")], response).into_response(),
        Err(error) => (StatusCode::INTERNAL_SERVER_ERROR, format!("{file}: {error}\n")).into_response(),
    }
}

//! The learner's page in a browser without a screen. Where Chromium is not installed, the test says so and is counted as
//! ignored.

use std::process::{Command, ExitCode, Output};

use libtest_mimic::{Arguments, Trial};
use popgym_tests::{Scene, net};

/// What Chromium is called by those who package it.
const BROWSERS: [&str; 3] = ["chromium", "chromium-browser", "google-chrome"];

/// The page as it stands after some seconds of the browser's own time, and what the browser said.
fn load(browser: &str, scene: &Scene, url: &str) -> Output {
    let mut command = Command::new(browser);
    command.args(["--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--dump-dom"]);
    command.arg(format!("--user-data-dir={}", scene.path("browser").display()));
    command.args(["--virtual-time-budget=6000", "--window-size=390,844", url]);
    command.output().expect("the browser starts")
}

fn the_page_shows_a_run(browser: &str) {
    let scene = Scene::new();
    let monitor = net::free_address();
    let flags = ["--metrics-listen", monitor.as_str(), "--steps", "10000000", "--checkpoint-epochs", "1"];
    let mut learner = scene.train("run", &flags);
    scene.reached(&mut learner, "run", 3);
    net::get(&monitor, "/run.json", &["\"silent_seconds\":0"]);
    let output = load(browser, &scene, &format!("http://{monitor}/"));
    let (page, said) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    // Errors of the page, and what its policy keeps it from.
    assert!(output.status.success() && !said.contains("CONSOLE"), "{said}");
    let shown = [
        "gru on popgym-RepeatPreviousEasy-v0, seed 0</h1>",
        ">running</span>",
        "href=\"files/metrics.csv\"",
        " connected, ",
    ];
    for text in shown {
        assert!(page.contains(text), "`{text}` is not on the page:\n{page}");
    }
    assert_eq!(page.matches("<path ").count(), 3, "range, mean and MMER:\n{page}");
    let row =
        page.split("<tbody id=\"actors\">").nth(1).and_then(|rest| rest.split("</tr>").next()).unwrap_or_default();
    assert_eq!(row.matches("<td>").count(), 8, "an actor has a row:\n{page}");
    assert!(learner.is_running());
}

fn main() -> ExitCode {
    let args = Arguments::from_args();
    let present =
        |program: &&str| Command::new(program).arg("--version").output().is_ok_and(|output| output.status.success());
    let browser = BROWSERS.into_iter().find(present);
    if browser.is_none() {
        eprintln!("skipped: Chromium is not installed");
    }
    let run = move || {
        the_page_shows_a_run(browser.unwrap_or_default());
        Ok(())
    };
    let test = Trial::test("the_page_shows_a_run", run).with_ignored_flag(browser.is_none());
    libtest_mimic::run(&args, vec![test]).exit_code()
}

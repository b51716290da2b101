//! The web server: it serves the page, and one WebSocket per browser.
//!
//! A browser requests each picture, so it never receives more than it draws. Pages of other sites receive nothing
//! ([`access`]).

use crate::access;
use crate::page::ASSETS;
use crate::picture::{Ask, picture};
use crate::scene::{Scene, Stage};
use axum::Router;
use axum::body::Bytes;
use axum::extract::ws::{CloseFrame, Message, WebSocket, WebSocketUpgrade, close_code};
use axum::extract::{Request, State};
use axum::http::StatusCode;
use axum::http::header::{
    CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, REFERRER_POLICY, X_CONTENT_TYPE_OPTIONS,
};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::net::TcpListener;
use tokio::sync::Semaphore;
use tokio::time::timeout;

const PICTURE_INTERVAL: Duration = Duration::from_millis(33);

/// Time after which a picture is sent even if nothing has changed.
const PATIENCE: Duration = Duration::from_millis(500);

/// Time after which a silent browser is pinged, and timeout for sending to it.
const SILENCE: Duration = Duration::from_secs(20);

/// Number of unanswered pings after which a browser counts as gone.
const MAX_PINGS: u32 = 3;

const MAX_ASK_BYTES: usize = 4096;

const MAX_BROWSERS: usize = 32;

const MAX_SPEED: f64 = 1e6;

/// Content security policy: the page may load only files of this program.
const POLICY: &str = "default-src 'self'; img-src 'self' data:; style-src 'self'; script-src 'self'; \
     connect-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'";

#[derive(Clone)]
struct Service {
    stage: Arc<Stage>,
    names: Arc<[String]>,
    places: Arc<Semaphore>,
}

pub async fn serve(
    listener: TcpListener,
    stage: Arc<Stage>,
    names: &[String],
) -> std::io::Result<()> {
    let service = Service {
        stage,
        names: names.into(),
        places: Arc::new(Semaphore::new(MAX_BROWSERS)),
    };
    let mut router = Router::new().route("/socket", get(socket));
    for asset in ASSETS {
        let headers = [
            (CONTENT_TYPE, asset.content_type),
            (CACHE_CONTROL, "no-cache"),
            (CONTENT_SECURITY_POLICY, POLICY),
            (X_CONTENT_TYPE_OPTIONS, "nosniff"),
            (REFERRER_POLICY, "no-referrer"),
        ];
        router = router.route(
            asset.path,
            get(move || async move { (headers, asset.text) }),
        );
    }
    let router = router
        .layer(from_fn_with_state(service.clone(), only_own_pages))
        .with_state(service);
    axum::serve(listener, router).await
}

async fn only_own_pages(State(service): State<Service>, request: Request, next: Next) -> Response {
    match access::check(request.headers(), &service.names) {
        Ok(()) => next.run(request).await,
        Err(problem) => {
            tracing::warn!("{problem}");
            (StatusCode::FORBIDDEN, problem).into_response()
        }
    }
}

async fn socket(State(service): State<Service>, upgrade: WebSocketUpgrade) -> Response {
    let upgrade = upgrade
        .max_message_size(MAX_ASK_BYTES)
        .max_frame_size(MAX_ASK_BYTES);
    // A page learns nothing about a refused upgrade, so the reason is sent when the socket closes.
    let Ok(place) = service.places.clone().try_acquire_owned() else {
        return upgrade.on_upgrade(close_full);
    };
    let stage = service.stage;
    upgrade.on_upgrade(async move |socket| {
        answer(socket, &stage).await;
        drop(place);
    })
}

async fn close_full(mut socket: WebSocket) {
    let reason = format!("expected at most {MAX_BROWSERS} browsers at a time: close one");
    let frame = CloseFrame {
        code: close_code::AGAIN,
        reason: reason.into(),
    };
    if send(&mut socket, Message::Close(Some(frame)))
        .await
        .is_none()
    {
        return;
    }
    // Requests that the browser sent before it learned the reason come first; then the socket ends.
    let ends = async { while let Some(Ok(_)) = socket.recv().await {} };
    let _ = timeout(SILENCE, ends).await;
}

async fn answer(mut socket: WebSocket, stage: &Stage) {
    let mut changes = stage.changes();
    let mut sent = Instant::now() - PICTURE_INTERVAL;
    let (mut early, mut before) = (None, None);
    while let Some(message) = next_message(&mut socket, &mut early).await {
        let text = match message {
            Message::Text(text) => text,
            Message::Ping(_) | Message::Pong(_) => continue,
            Message::Binary(_) | Message::Close(_) => return,
        };
        let ask: Ask = match serde_json::from_str(&text) {
            Ok(ask) => ask,
            Err(error) => {
                tracing::warn!("a browser sent an invalid request: {error}");
                return;
            }
        };
        order(stage, &ask);
        tokio::time::sleep(PICTURE_INTERVAL.saturating_sub(sent.elapsed())).await;
        // A request for another world or step is answered at once, even if nothing has changed.
        let wanted = Some((ask.world, ask.at));
        if before == wanted {
            tokio::select! {
                // A change since the last picture, or the next request, ends the wait.
                _ = timeout(PATIENCE, changes.changed()) => {}
                message = socket.recv() => match message {
                    Some(Ok(message)) => early = Some(message),
                    _ => return,
                },
            }
        }
        before = wanted;
        sent = Instant::now();
        let bytes = picture(&stage.look(), &ask, sent);
        let message = Message::Binary(bytes.into());
        if send(&mut socket, message).await.is_none() {
            return;
        }
    }
}

/// Returns the next message, which may have arrived during the last answer. Returns `None` if the browser is gone, or
/// does not answer pings.
async fn next_message(socket: &mut WebSocket, early: &mut Option<Message>) -> Option<Message> {
    if let Some(message) = early.take() {
        return Some(message);
    }
    for _ in 0..MAX_PINGS {
        match timeout(SILENCE, socket.recv()).await {
            Ok(message) => return message?.ok(),
            Err(_) => send(socket, Message::Ping(Bytes::new())).await?,
        }
    }
    None
}

async fn send(socket: &mut WebSocket, message: Message) -> Option<()> {
    timeout(SILENCE, socket.send(message)).await.ok()?.ok()
}

fn order(stage: &Stage, ask: &Ask) {
    if ask.speed.is_none() && ask.playing.is_none() {
        return;
    }
    stage.change(|scene: &mut Scene| {
        let Some(player) = &mut scene.player else {
            return;
        };
        if let Some(speed) = ask.speed.filter(|speed| speed.is_finite()) {
            player.speed = speed.clamp(0.0, MAX_SPEED);
        }
        player.playing = ask.playing.unwrap_or(player.playing);
    });
}

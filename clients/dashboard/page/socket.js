// The connection to the dashboard. The page pulls: it sends a request, receives exactly one picture, draws it when the
// browser is ready, and sends the next request. So a slow or hidden page receives fewer pictures, and none are queued.

import { decode } from "./wire.js";

const RETRY_MILLIS = 1000;
// The code of a dashboard that has no place for another browser (RFC 6455, registry of close codes).
const TRY_AGAIN_LATER = 1013;
// The dashboard answers within half a second, so a connection that is silent for this long is dead.
const SILENCE_MILLIS = 6000;
// One request waits for changes. A second request can be pending at the same time, so that scrubbing need not wait.
const MAX_REQUESTS = 2;

/**
 * Keeps a connection up for as long as the page lives.
 * `ask()` returns the next request. `show(picture)` draws a picture. `superseded(picture)` returns whether to skip a
 * picture because a newer request is pending. `up(isUp, reason)` is called when the connection is made or lost; `reason`
 * says why the dashboard refuses it. `failed(error)` is called when a picture cannot be read.
 */
export function connect({ ask, show, superseded, up, failed }) {
  let socket = null;
  let asked = 0;
  let isStale = false;
  let watchdog = 0;

  function open() {
    // The address is relative to the page, because a proxy may serve the page below a path, and with TLS.
    const address = new URL("socket", location.href);
    address.protocol = address.protocol === "https:" ? "wss:" : "ws:";
    socket = new WebSocket(address);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => { asked = 0; isStale = false; up(true); send(); };
    socket.onmessage = (event) => receive(event.data);
    socket.onclose = (event) => {
      clearTimeout(watchdog);
      up(false, event.code === TRY_AGAIN_LATER ? event.reason : null);
      setTimeout(open, RETRY_MILLIS);
    };
  }

  function send() {
    asked += 1;
    isStale = false;
    socket.send(JSON.stringify(ask()));
    watch(socket);
  }

  function watch(watched) {
    clearTimeout(watchdog);
    if (asked > 0) watchdog = setTimeout(() => watched.close(), SILENCE_MILLIS);
  }

  function receive(buffer) {
    asked -= 1;
    watch(socket);
    if (isStale) send();
    const picture = attempt(() => decode(buffer));
    const from = socket;
    requestAnimationFrame(() => {
      // If the socket has closed meanwhile, its picture must not replace the page's notice.
      if (from.readyState !== WebSocket.OPEN) return;
      const isOvertaken = asked > 0;
      if (picture && !(isOvertaken && superseded(picture))) attempt(() => show(picture));
      if (asked === 0) send();
    });
  }

  function attempt(action) {
    try {
      return action();
    } catch (error) {
      failed(error);
      return null;
    }
  }

  /** Sends a request at once. Called when the visitor wants another picture. */
  function hurry() {
    if (socket?.readyState !== WebSocket.OPEN) return;
    if (asked < MAX_REQUESTS) send();
    else isStale = true;
  }

  open();
  return { hurry };
}

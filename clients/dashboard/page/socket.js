// The connection to the dashboard. The page pulls: it asks, gets exactly one picture, draws it in the
// browser's own time, and asks again. So a slow or hidden page gets fewer pictures and nothing queues.

import { decode } from "./wire.js";

const RETRY_MILLIS = 1000;
// The dashboard answers within half a second; a connection that is silent for longer is dead.
const SILENCE_MILLIS = 6000;
// Beside the ask that waits for news, one more may be under way: so that scrubbing need not wait.
const MOST_ASKS = 2;

/**
 * Keeps a connection up for as long as the page lives.
 *
 * `ask()` gives the next ask; `show(picture)` draws one; `superseded(picture)` tells whether a picture
 * that a newer ask has overtaken is not worth drawing; `up(isUp)` hears of connections made and lost;
 * `failed(error)` of pictures that cannot be read.
 */
export function connect({ ask, show, superseded, up, failed }) {
  let socket = null;
  let asked = 0;
  let isStale = false;
  let watchdog = 0;

  function open() {
    // Next to the page: a proxy may serve it below a path, and with TLS.
    const address = new URL("socket", location.href);
    address.protocol = address.protocol === "https:" ? "wss:" : "ws:";
    socket = new WebSocket(address);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => { asked = 0; isStale = false; up(true); send(); };
    socket.onmessage = (event) => receive(event.data);
    socket.onclose = () => { clearTimeout(watchdog); up(false); setTimeout(open, RETRY_MILLIS); };
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
      // It has closed meanwhile: that is told, and no picture of it takes the place of that.
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

  /** Asks again at once, as what is wanted has changed. */
  function hurry() {
    if (socket?.readyState !== WebSocket.OPEN) return;
    if (asked < MOST_ASKS) send();
    else isStale = true;
  }

  open();
  return { hurry };
}

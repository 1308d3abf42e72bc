// Listens to the operator and draws what it sends. Everything is drawn from the newest view; nothing is asked for and nothing is sent.

import { element, number, update } from "./elements.js";
import { ended, failures, keyOf, leaderboards, running, waiting } from "./sections.js";

const SECTIONS = { leaderboards, running, waiting, ended, failures };
// Times on the page move on without news.
const REDRAW_MS = 10_000;
const AGAIN_MS = 15_000;

const byId = (id) => document.getElementById(id);
const [connection, notice, replica] = ["connection", "notice", "replica"].map(byId);
const [board, text] = ["leaderboard", "text"].map(byId);

let view = null;

function show(state, message) {
  if (connection.dataset.state === state && connection.textContent === message) return;
  connection.dataset.state = state;
  connection.textContent = message;
}

// What is chosen above the lists.
function context() {
  const wanted = text.value.trim().toLowerCase();
  const namespaces = new Set(view.leaderboards.rows.map((row) => row.namespace));
  const fitsBoard = (row) => !board.value || `${row.namespace}/${row.leaderboard}` === board.value;
  const fitsText = (row) => [row.name, row.team, row.track].some((each) => each?.toLowerCase().includes(wanted));
  return {
    now: Date.now() / 1000,
    leaderboard: board.value,
    isQualified: namespaces.size > 1,
    fits: (row) => fitsBoard(row) && (!wanted || fitsText(row)),
  };
}

function choices() {
  const keys = view.leaderboards.rows.map(keyOf);
  const fresh = element("select", {}, element("option", { value: "" }, "All"), keys.map((key) => element("option", { value: key, "data-key": key }, key)));
  const chosen = board.value;
  update(board, fresh);
  board.value = keys.includes(chosen) ? chosen : "";
}

function draw() {
  if (!view) return;
  choices();
  const now = context();
  for (const [name, section] of Object.entries(SECTIONS)) {
    const place = byId(name);
    update(place.querySelector(".content"), section(view, now));
    const count = place.querySelector(".count");
    if (count) count.textContent = number(view[name].count);
  }
  document.title = `${number(view.running.count)} running, ${number(view.waiting.count)} in line`;
  const role = view.replica.leads ? "which leads" : "which stands by and shows the same";
  replica.textContent = `Read-only. leaderboard-operator ${view.version}, replica ${view.replica.name}, ${role}.`;
  notice.hidden = view.replica.isComplete;
  notice.textContent = notice.hidden ? "" : "The operator has not read everything yet, or cannot read some objects: lists may lack some.";
}

function listen() {
  const events = new EventSource("events");
  events.onmessage = (event) => {
    view = JSON.parse(event.data);
    show("live", "Live");
    draw();
  };
  events.addEventListener("full", () => show("full", "All places are taken; this page tries again by itself."));
  events.onerror = () => {
    if (connection.dataset.state !== "full") show("lost", view ? "Connection lost; what you see is old. Reconnecting…" : "No answer yet. Reconnecting…");
    // A browser gives up after an answer that is none; this page does not.
    if (events.readyState === EventSource.CLOSED) setTimeout(listen, AGAIN_MS);
  };
}

board.addEventListener("change", draw);
text.addEventListener("input", draw);
setInterval(draw, REDRAW_MS);
listen();

// Listens to the operator and draws what it sends. Everything is drawn from the newest view. One submission is asked for while its
// dialog is open, and nothing else is sent.

import { detail, missing } from "./detail.js";
import { element, number, update } from "./elements.js";
import { ended, failures, keyOf, leaderboards, running, standings, waiting } from "./sections.js";

const SECTIONS = { standings, running, waiting, leaderboards, failures, ended };
// Times on the page move on without news.
const REDRAW_MS = 10_000;
const AGAIN_MS = 15_000;
const SUBMISSION = /^#\/([a-z0-9.-]+)\/([a-z0-9.-]+)$/;

const byId = (id) => document.getElementById(id);
const [connection, notice, replica, title, dialog, copied] = ["connection", "notice", "replica", "title", "detail", "copied"].map(byId);
const [board, text] = ["leaderboard", "text"].map(byId);

let view = null;
// The table of the standings that somebody chose.
let table = null;
// How often more rows were asked for, by section.
const steps = new Map();
// The submission of the dialog: its names, and what the operator said of it.
let opened = null;
let hasEntry = false;

function show(state, message) {
  if (connection.dataset.state === state && connection.textContent === message) return;
  connection.dataset.state = state;
  connection.textContent = message;
}

// What is chosen above the lists.
function context() {
  const wanted = text.value.trim().toLowerCase();
  const boards = view.leaderboards.rows;
  const isChosen = (row) => !board.value || `${row.namespace}/${row.leaderboard}` === board.value;
  const fitsText = (row) => [row.name, row.team, row.track].some((each) => each?.toLowerCase().includes(wanted));
  return {
    now: Date.now() / 1000,
    table,
    steps: (name) => steps.get(name) ?? 0,
    hasBoards: boards.length > 1,
    isQualified: new Set(boards.map((row) => row.namespace)).size > 1,
    isChosen,
    fits: (row) => isChosen(row) && (!wanted || fitsText(row)),
  };
}

function choices() {
  const keys = view.leaderboards.rows.map(keyOf);
  const fresh = element("select", {}, element("option", { value: "" }, "All leaderboards"), keys.map((key) => element("option", { value: key, "data-key": key }, key)));
  const chosen = board.value;
  update(board, fresh);
  board.value = keys.includes(chosen) ? chosen : "";
  board.closest("label").hidden = keys.length < 2;
}

function draw() {
  if (!view) return;
  choices();
  const now = context();
  for (const [name, section] of Object.entries(SECTIONS)) {
    const place = byId(name);
    const content = element("div", {}, section(view, now));
    update(place.querySelector(".content"), content);
    const count = place.querySelector(".count");
    if (count) count.textContent = number(view[name].count);
  }
  const name = view.replica.title || "Leaderboards";
  title.textContent = name;
  document.title = `${number(view.running.count)} running, ${number(view.waiting.count)} queued · ${name}`;
  const role = view.replica.leads ? "which leads" : "which stands by and shows the same";
  replica.textContent = `Read-only. leaderboard-operator ${view.version}, replica ${view.replica.name}, ${role}.`;
  notice.hidden = view.replica.isComplete;
  notice.textContent = notice.hidden ? "" : "The operator has not read everything yet, or cannot read some objects: lists may lack some.";
  drawDetail();
}

function drawDetail() {
  if (!opened) return;
  byId("detail-title").textContent = opened.name;
  const { row } = opened;
  const content = row ? detail(row, Date.now() / 1000) : row === null ? missing(opened.name) : element("div", {}, element("p", { class: "empty" }, "Loading…"));
  update(dialog.querySelector(".content"), content);
}

async function load() {
  const asked = opened;
  if (!asked) return;
  try {
    const answer = await fetch(`submissions/${asked.namespace}/${asked.name}`);
    if (answer.ok) asked.row = await answer.json();
    else if (answer.status === 404) asked.row = null;
  } catch {
    // That the connection is lost is shown already.
  }
  if (asked === opened) drawDetail();
}

// Opens and closes the dialog as the address says.
function route() {
  const found = SUBMISSION.exec(location.hash);
  opened = found && { namespace: found[1], name: found[2] };
  if (!opened) {
    dialog.close();
    return;
  }
  copied.textContent = "";
  drawDetail();
  if (!dialog.open) dialog.showModal();
  dialog.querySelector(".content").scrollTop = 0;
  load();
}

// The reader has closed it: the address follows.
function closed() {
  const focus = document.activeElement;
  if (focus === document.body || dialog.contains(focus)) title.focus();
  if (!opened) return;
  opened = null;
  if (hasEntry) history.back();
  else history.replaceState(null, "", location.pathname);
}

async function copy(wanted) {
  try {
    await navigator.clipboard.writeText(wanted);
    copied.textContent = "Copied.";
  } catch {
    copied.textContent = "The browser did not allow it: select the text and copy it.";
  }
}

function pressed({ target }) {
  const button = target.closest("button");
  if (target === dialog || button?.id === "close") dialog.close();
  else if (button?.dataset.copy) copy(button.dataset.copy);
  else if (button?.dataset.table) choose(button);
  else if (button?.dataset.more) more(button.dataset.more);
}

function choose(tab) {
  table = tab.dataset.table;
  draw();
  tab.focus();
}

// The first row that was hidden gets the focus if the button has gone.
function more(name) {
  const before = byId(name).querySelectorAll(".open").length;
  steps.set(name, (steps.get(name) ?? 0) + 1);
  draw();
  byId(name).querySelectorAll(".open")[before]?.focus();
}

const MOVES = { ArrowRight: (at, last) => (at === last ? 0 : at + 1), ArrowLeft: (at, last) => (at === 0 ? last : at - 1), Home: () => 0, End: (_, last) => last };

function moved(event) {
  const tab = event.target.closest("[role=tab]");
  const move = MOVES[event.key];
  if (!tab || !move) return;
  event.preventDefault();
  const tabs = [...tab.parentElement.children];
  choose(tabs[move(tabs.indexOf(tab), tabs.length - 1)]);
}

function listen() {
  const events = new EventSource("events");
  events.onmessage = (event) => {
    view = JSON.parse(event.data);
    show("live", "Live");
    draw();
    load();
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
document.addEventListener("click", pressed);
document.addEventListener("keydown", moved);
dialog.addEventListener("close", closed);
addEventListener("hashchange", () => {
  hasEntry = true;
  route();
});
setInterval(draw, REDRAW_MS);
route();
listen();

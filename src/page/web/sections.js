// Each section of the page from its part of the view.

import { ago, badge, bar, element, graphic, link, number, span } from "./elements.js";
import { lengths } from "./timeline.js";

// Rows that a section shows before somebody asks for more, and how many come then.
const FIRST = { standings: 10, running: 8, waiting: 12, leaderboards: 4, failures: 5, ended: 8 };
const STEP = 20;
// Medians of fewer runs say nothing.
const RUNS = 5;
// A budget of requests is scarce from this share on.
const SCARCE = 0.8;

export function keyOf(row) {
  return `${row.namespace}/${row.name}`;
}

// Whose failure it is has its colour: red asks the hosts to act, amber does not.
export function fault(failureClass) {
  return failureClass === "Infrastructure" ? "bad" : "warn";
}

function boardOf(row, context) {
  return context.isQualified ? `${row.namespace}/${row.leaderboard}` : row.leaderboard;
}

// Opens the submission; its whole row is the link's ground.
function open(row) {
  return element("a", { class: "open", href: `#/${keyOf(row)}` }, row.name);
}

function who(row, context) {
  const facts = [row.track, context.hasBoards ? boardOf(row, context) : null].filter(Boolean).map((fact) => [" ", element("span", { class: "whole" }, `· ${fact}`)]);
  const name = row.team ?? (row.isCheck ? "Check" : row.name);
  return element("div", { class: "who" }, element("strong", {}, name), element("span", { class: "muted" }, open(row), facts));
}

// The first rows of a list that fit the filter, drawn by `row`; below them what is left.
function rows(name, list, context, empty, draw) {
  const fitting = list.rows.filter(context.fits);
  if (!fitting.length) return element("p", { class: "empty" }, list.count === 0 ? empty : "Nothing fits the filter.");
  const most = FIRST[name] + STEP * context.steps(name);
  const left = fitting.length - most;
  const hidden = list.count - list.rows.length;
  const button = left > 0 ? element("button", { type: "button", class: "more", "data-more": name }, `Show ${Math.min(left, STEP)} more`) : null;
  const rest = left <= 0 && hidden > 0 ? element("p", { class: "muted rest" }, `${number(hidden)} more: `, element("code", {}, "kubectl leaderboard status"), " lists all.") : null;
  return element("div", {}, draw(fitting.slice(0, most)), button, rest);
}

function list(items, attributes = {}) {
  return element("ul", { class: "rows", ...attributes }, items);
}

const MEDALS = ["gold", "silver", "bronze"];

function standing(row, table, context) {
  const known = { namespace: table.namespace, name: row.name };
  const place = element("span", { class: `place ${MEDALS[row.rank - 1] ?? ""}` }, row.rank);
  const team = element("div", { class: "who" }, element("strong", {}, row.team ?? row.name), element("span", { class: "muted" }, open(known), row.finished === null ? null : [" · ", ago(row.finished, context.now)]));
  return element(
    "tr",
    { "data-key": row.name },
    element("td", {}, place),
    element("th", { scope: "row" }, team),
    row.values.map((value) => element("td", { class: "metric" }, value ?? "–")),
    element("td", { class: "score" }, row.score),
  );
}

function ranking(table, context) {
  const all = { count: table.rows.length, rows: table.rows.map((row) => ({ ...row, leaderboard: table.leaderboard, namespace: table.namespace })) };
  return rows("standings", all, context, "No result yet: the first finished run of this track opens the ranking.", (shown) =>
    element(
      "table",
      {},
      element("caption", {}, `Best result of each team; ${table.ascending ? "the lowest" : "the highest"} ${(table.metric ?? "score").toLowerCase()} leads.`),
      element("thead", {}, element("tr", {}, element("th", { scope: "col" }, element("span", { class: "hidden" }, "Rank")), element("th", { scope: "col" }, "Team"), table.metrics.map((metric) => element("th", { scope: "col", class: "metric" }, metric)), element("th", { scope: "col", class: "score" }, table.metric ?? "Score"))),
      element("tbody", {}, shown.map((row) => standing(row, table, context))),
    ),
  );
}

export function standings(view, context) {
  const tables = view.standings.rows.filter((table) => context.isChosen(table));
  const key = (table) => `${table.namespace}/${table.leaderboard}/${table.track}`;
  const chosen = tables.find((table) => key(table) === context.table) ?? tables.find((table) => table.rows.length) ?? tables[0];
  if (!chosen) return element("p", { class: "empty" }, "No Leaderboard is here yet.");
  const tab = (table) => {
    const isChosen = table === chosen;
    const text = context.hasBoards ? `${boardOf(table, context)} · ${table.track}` : table.track;
    return element("button", { type: "button", role: "tab", id: `tab-${key(table)}`, "data-key": key(table), "data-table": key(table), "aria-selected": String(isChosen), "aria-controls": "ranking", tabindex: isChosen ? 0 : -1 }, text);
  };
  if (tables.length === 1) return ranking(chosen, context);
  const hidden = view.standings.count - view.standings.rows.length;
  return element("div", {}, element("div", { class: "tabs", role: "tablist", "aria-label": "Tracks" }, tables.map(tab)), element("div", { id: "ranking", role: "tabpanel", "aria-labelledby": `tab-${key(chosen)}` }, ranking(chosen, context)), hidden > 0 ? element("p", { class: "muted rest" }, `${number(hidden)} more tracks: `, element("code", {}, "kubectl leaderboard scores"), " lists all.") : null);
}

// Progress of a run: one part for each of its workers.
function progress(row) {
  const parts = row.workers.length ? row.workers : [row];
  const bars = parts.map((part) => bar(part.total ? part.done / part.total : 0, part.crashes ? "warn" : "running"));
  const label = { role: "progressbar", "aria-label": `Progress of ${row.name}`, "aria-valuemin": 0, "aria-valuemax": Math.max(row.total, 1), "aria-valuenow": Math.min(row.done, Math.max(row.total, 1)) };
  const share = row.total ? ` · ${Math.floor((100 * row.done) / row.total)} %` : "";
  return element("div", { class: "progress" }, element("div", { class: "parts", ...label }, bars), element("span", { class: "muted" }, `${row.done}/${row.total} ${row.unit}${share}`));
}

function trouble(row) {
  const crashed = row.workers.filter((worker) => worker.crashes > 0);
  const texts = crashed.map((worker) => `Worker ${worker.id}: ${worker.crashes} ${worker.crashes === 1 ? "crash" : "crashes"}`);
  return [row.attempt > 1 ? badge("plain", `Attempt ${row.attempt}`) : null, texts.length ? badge("warn", texts.join(", ")) : null];
}

function fact(value, ...note) {
  return element("div", { class: "fact" }, element("span", {}, value), element("span", { class: "muted", title: note.filter(Boolean).join(" ") || null }, note));
}

export function running(view, context) {
  return rows("running", view.running, context, "Nothing runs.", (shown) =>
    list(
      shown.map((row) => {
        const since = row.phases.started ?? row.phases.submitted;
        return element(
          "li",
          { class: "row run", "data-key": keyOf(row) },
          element("div", {}, who(row, context), element("div", { class: "badges" }, trouble(row))),
          progress(row),
          fact(row.score?.replace("~", "") ?? "–", "score so far"),
          fact(since === null ? "–" : span(context.now - since), row.node ? `on ${row.node}` : "running"),
        );
      }),
    ),
  );
}

export function waiting(view, context) {
  const group = ([key, members]) => {
    const [{ reason, message }] = members;
    const items = members.map((row) =>
      element(
        "li",
        { class: "row wait", "data-key": keyOf(row) },
        element("span", { class: "place" }, row.position === null ? "–" : row.position, element("span", { class: "hidden" }, row.position === null ? "no place" : ". in line")),
        who(row, context),
        fact(row.eta ? `~${row.eta}` : "–", row.eta ? "until it starts" : "no estimate"),
        fact(row.since === null ? "–" : span(context.now - row.since), "in the queue"),
      ),
    );
    return element("div", { class: "group", "data-key": key }, element("p", { class: "why" }, badge("plain", reason ?? "New"), " ", message), list(items));
  };
  return rows("waiting", view.waiting, context, "Nobody waits.", (shown) => {
    const groups = Map.groupBy(shown, (row) => `${row.reason}: ${row.message}`);
    return element("div", {}, [...groups].map(group));
  });
}

// How much of the slots is taken.
function ring(row) {
  const share = row.slots ? Math.min(100, (100 * row.inUse) / row.slots) : 0;
  const circle = { cx: 18, cy: 18, r: 15.915 };
  const label = row.slots === null ? `${row.inUse} in use, without a limit` : `${row.inUse} of ${row.slots} slots in use`;
  return graphic(
    "svg",
    { class: "ring", viewBox: "0 0 36 36", role: "img", "aria-label": label },
    graphic("circle", circle),
    share ? graphic("circle", { ...circle, class: "running", "stroke-dasharray": `${share.toFixed(1)} 100`, transform: "rotate(-90 18 18)" }) : null,
    graphic("text", { x: 18, y: 19.5, "text-anchor": "middle" }, row.slots === null ? row.inUse : `${row.inUse}/${row.slots}`),
    graphic("text", { class: "unit", x: 18, y: 25.5, "text-anchor": "middle" }, row.slots === null ? "in use" : "slots"),
  );
}

function budget(evalai) {
  const share = evalai.limit ? evalai.used / evalai.limit : 0;
  const kind = share >= 1 ? "bad" : share > SCARCE ? "warn" : "";
  const backlog = evalai.waiting ? `${number(evalai.waiting)} results on their way` : "all results published";
  return [element("dt", {}, "EvalAI API budget"), element("dd", {}, element("span", { class: kind }, `${evalai.used} of ${evalai.limit} requests per minute`), ` · ${backlog}`)];
}

function typical(times) {
  const moments = { submitted: 0, scheduled: times.waiting, started: times.waiting + times.starting };
  moments.finished = moments.started + times.running;
  moments.published = moments.finished + times.publishing;
  return [element("dt", {}, `Typical run, median of ${times.runs}`), element("dd", {}, lengths(moments, moments.published))];
}

export function leaderboards(view, context) {
  const board = (row) => {
    const state = row.trouble ? badge("bad", "Not ready") : row.isPaused ? badge("warn", "Paused") : badge("good", "Ready");
    const counts = [["Running", row.running], ["Queued", row.waiting], ["Finished", row.finished], ["Failed", row.failed], ["Cancelled", row.cancelled]];
    return element(
      "li",
      { class: "row board", "data-key": keyOf(row) },
      element("div", { class: "name" }, element("h3", {}, context.isQualified ? keyOf(row) : row.name), state, row.trouble && row.isPaused ? badge("warn", "Paused") : null, row.challenge ? link(row.challenge, "EvalAI") : null),
      row.trouble ? element("p", { class: "bad" }, row.trouble) : null,
      element("div", { class: "load" }, ring(row), element("dl", { class: "counts" }, counts.map(([name, count]) => element("div", {}, element("dt", {}, name), element("dd", {}, number(count)))))),
      element("dl", { class: "facts" }, row.evalai ? budget(row.evalai) : null, row.typical?.runs >= RUNS ? typical(row.typical) : null),
    );
  };
  const all = { ...view.leaderboards, rows: view.leaderboards.rows.map((row) => ({ ...row, leaderboard: row.name })) };
  const fits = (row) => context.isChosen(row);
  return rows("leaderboards", all, { ...context, fits }, "No Leaderboard is here yet: apply one, and it shows here.", (shown) => list(shown.map(board)));
}

export function failures(view, context) {
  const classes = Map.groupBy(view.failures.classes, (each) => each.class);
  const chips = [...classes].map(([name, each]) => element("p", { class: "chips", "data-key": name }, element("span", { class: "muted" }, name), each.map((one) => badge(fault(name), one.reason, element("b", {}, number(one.count))))));
  const items = rows("failures", view.failures, context, "Nothing has failed.", (shown) =>
    list(
      shown.map((row) =>
        element("li", { class: "row fail", "data-key": keyOf(row) }, who(row, context), fact(badge(fault(row.class), row.reason), row.time === null ? null : ago(row.time, context.now)), element("p", { class: "why" }, row.message)),
      ),
    ),
  );
  return element("div", {}, chips, items);
}

export function outcome(row) {
  const kinds = { Finished: "good", Failed: fault(row.class), Running: "blue", Resumed: "blue" };
  return badge(kinds[row.state] ?? "plain", row.state);
}

export function ended(view, context) {
  return rows("ended", view.ended, context, "Nothing has ended yet.", (shown) =>
    list(
      shown.map((row) =>
        element(
          "li",
          { class: "row end", "data-key": keyOf(row) },
          who(row, context),
          fact(row.state === "Finished" && row.score ? row.score : outcome(row), row.phases.finished === null ? null : ago(row.phases.finished, context.now)),
          row.open.length ? element("div", { class: "badges" }, badge("warn", `Not yet in ${row.open.join(", ")}`)) : null,
        ),
      ),
    ),
  );
}

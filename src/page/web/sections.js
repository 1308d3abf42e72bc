// Each section of the page from its part of the view.

import { ago, element, graphic, number, span } from "./elements.js";

const PHASES = [
  ["waiting", "waited", "submitted"],
  ["starting", "started in", "scheduled"],
  ["running", "ran", "started"],
  ["publishing", "published in", "finished"],
];

const WORKER = {
  Waiting: "waiting",
  Running: "running",
  Done: "done",
  Crashed: "crashed, starts again",
  Unknown: "",
};

export function keyOf(row) {
  return `${row.namespace}/${row.name}`;
}

// The seconds of each phase; of one that goes on, until now.
function lengths(phases, now) {
  const ends = [phases.scheduled, phases.started, phases.finished, phases.published];
  return PHASES.map(([, , from], at) => {
    const begin = phases[from];
    if (begin === null) return 0;
    // A phase that was left out ends with the next moment that is known.
    const end = ends.slice(at).find((moment) => moment !== null);
    const isOver = phases.finished !== null && at === 3 && phases.published === null;
    return isOver ? 0 : Math.max(0, (end ?? now) - begin);
  }).map((length, at, all) => (at > 0 && phases[PHASES[at][2]] === null ? 0 : length));
}

// A bar with one part for each phase; `scale` is how many seconds its whole width stands for.
function picture(seconds, scale) {
  let x = 0;
  const parts = PHASES.map(([name], at) => {
    const share = scale > 0 ? (100 * seconds[at]) / scale : 0;
    const width = seconds[at] > 0 ? Math.max(share, 0.6) : 0;
    const part = graphic("rect", { class: name, x: x.toFixed(2), y: 0, width: width.toFixed(2), height: 10 });
    x += width;
    return part;
  });
  const texts = PHASES.map(([, verb], at) => (seconds[at] > 0 ? `${verb} ${span(seconds[at])}` : null));
  const label = texts.filter(Boolean).join(", ") || "no times yet";
  const width = Math.max(x, 100).toFixed(2);
  const size = { viewBox: `0 0 ${width} 10`, preserveAspectRatio: "none" };
  return element(
    "div",
    { class: "picture" },
    graphic("svg", { class: "phases", role: "img", "aria-label": label, ...size }, parts),
    element("span", { class: "times", "aria-hidden": "true" }, label),
  );
}

export function legend() {
  const items = PHASES.map(([name]) => element("li", {}, element("span", { class: `swatch ${name}` }), name));
  return element("ul", { class: "legend", "aria-label": "Phases" }, items);
}

function sum(numbers) {
  return numbers.reduce((all, one) => all + one, 0);
}

function longest(rows, now) {
  return Math.max(1, ...rows.map((row) => sum(lengths(row.phases, now))));
}

function who(row, context) {
  const board = context.isQualified ? `${row.namespace}/${row.leaderboard}` : row.leaderboard;
  const facts = [row.team ?? (row.isCheck ? "a check" : null), row.track, board].filter(Boolean);
  return element(
    "div",
    { class: "who" },
    element("strong", {}, row.name),
    element("span", { class: "muted" }, facts.join(" · ")),
  );
}

function bar(done, total, label) {
  return element("progress", { max: Math.max(total, 1), value: Math.min(done, Math.max(total, 1)), "aria-label": label });
}

function more(list, shown) {
  const hidden = list.count - list.rows.length;
  const texts = [];
  if (shown < list.rows.length) texts.push(`${number(shown)} of ${number(list.rows.length)} fit the filter`);
  if (hidden > 0) texts.push(`${number(hidden)} more are not shown: kubectl leaderboard status lists all`);
  return texts.length ? element("p", { class: "muted more" }, `${texts.join("; ")}.`) : null;
}

// A list, or a sentence where there is nothing.
function rows(list, context, empty, row) {
  const fitting = list.rows.filter(context.fits);
  const nothing = list.count === 0 ? empty : "Nothing fits the filter.";
  const items = fitting.map((each) => row(each));
  const kind = context.kind ?? "ul";
  const content = items.length ? element(kind, { class: "rows" }, items) : element("p", { class: "muted" }, nothing);
  return element("div", {}, context.before, content, more(list, fitting.length));
}

function fact(term, ...value) {
  return element("div", { class: "fact" }, element("dt", {}, term), element("dd", {}, value));
}

function budget(evalai) {
  const text = `${evalai.used} of ${evalai.limit} requests in the last minute`;
  const backlog = evalai.waiting
    ? `${number(evalai.waiting)} results on their way, the last at about ${clock(evalai.lastExpected)}`
    : "all results are there";
  const said = [`${text}; `, element("span", { class: "muted" }, backlog)];
  return fact("Budget of EvalAI", bar(evalai.used, evalai.limit, "Requests to EvalAI"), said);
}

function clock(seconds) {
  const format = { hour: "2-digit", minute: "2-digit", hour12: false };
  return new Date(seconds * 1000).toLocaleTimeString("en", format);
}

function typical(runs) {
  const seconds = [runs.waiting, runs.starting, runs.running, runs.publishing];
  const of = runs.runs === 1 ? "Where the time went in the last run" : `Where the time went: medians of the last ${runs.runs} runs`;
  return fact(of, picture(seconds, sum(seconds)));
}

function board(row, context) {
  const slots = row.slots === null ? "no limit" : `${number(row.inUse)} of ${row.slots} slots`;
  const marks = [row.isPaused ? element("span", { class: "badge waiting" }, "paused") : null];
  marks.push(row.trouble === null ? null : element("span", { class: "badge failed" }, "not ready"));
  const counts = [
    fact("Running", `${number(row.running)} `, element("span", { class: "muted" }, slots)),
    fact("In line", number(row.waiting)),
    fact("Finished", number(row.finished)),
    fact("Failed", number(row.failed)),
    fact("Cancelled", number(row.cancelled)),
  ];
  return element(
    "li",
    { class: "card", "data-key": keyOf(row) },
    element("h3", {}, context.isQualified ? keyOf(row) : row.name, marks),
    row.trouble === null ? null : element("p", { class: "trouble" }, row.trouble),
    element("dl", { class: "counts" }, counts),
    element("dl", {}, row.evalai && budget(row.evalai), row.typical && typical(row.typical)),
  );
}

export function leaderboards(view, context) {
  const shown = view.leaderboards.rows.filter((row) => !context.leaderboard || keyOf(row) === context.leaderboard);
  const hidden = view.leaderboards.count - view.leaderboards.rows.length;
  const cards = element("ul", { class: "cards" }, shown.map((row) => board(row, context)));
  const empty = element("p", { class: "muted" }, "There is no Leaderboard yet.");
  const rest = hidden > 0 ? element("p", { class: "muted more" }, `${number(hidden)} more are not shown.`) : null;
  return element("div", {}, shown.length ? [legend(), cards] : empty, rest);
}

function worker(each) {
  const crashes = each.crashes === 1 ? "1 crash" : `${each.crashes} crashes`;
  const last = each.last ? ` (${each.last})` : "";
  const state = each.crashes ? `${WORKER[each.state]}, ${crashes}${last}` : WORKER[each.state];
  return element(
    "li",
    { "data-key": each.id, "data-state": each.state },
    element("span", { class: "label" }, `Worker ${each.id}`),
    bar(each.done, each.total, `Progress of worker ${each.id}`),
    element("span", {}, `${each.done}/${each.total}`),
    element("span", { class: "muted state" }, state),
  );
}

export function running(view, context) {
  const scale = longest(view.running.rows, context.now);
  return rows(view.running, context, "Nothing runs.", (row) => {
    const score = row.score ? element("span", { class: "score" }, row.score) : null;
    const notes = [row.attempt > 1 ? `attempt ${row.attempt}` : null, row.node ? `on ${row.node}` : null];
    if (row.reason && row.reason !== "Running" && row.reason !== "Resumed") notes.push(row.reason);
    const workers = element("ul", { class: "workers", "aria-label": `Workers of ${row.name}` }, row.workers.map(worker));
    return element(
      "li",
      { class: "row run", "data-key": keyOf(row) },
      who(row, context),
      element(
        "div",
        { class: "side" },
        element("div", { class: "whole" }, bar(row.done, row.total, `Progress of ${row.name}`), `${row.done}/${row.total} ${row.unit}`, score),
        element("span", { class: "muted notes" }, notes.filter(Boolean).join(" · ")),
      ),
      picture(lengths(row.phases, context.now), scale),
      row.workers.length ? workers : null,
    );
  });
}

export function waiting(view, context) {
  return rows(view.waiting, { ...context, kind: "ol" }, "Nobody waits.", (row) => {
    const place = row.position === null ? "–" : String(row.position);
    const since = row.since === null ? null : [" · came ", ago(row.since, context.now)];
    return element(
      "li",
      { class: "row wait", "data-key": keyOf(row) },
      element("span", { class: "place" }, element("span", { class: "hidden" }, row.position === null ? "no place" : "place "), place),
      who(row, context),
      element("p", { class: "why" }, element("b", {}, row.reason ?? "New"), " ", row.message),
      element("span", { class: "muted notes" }, row.eta ? `starts in about ${row.eta}` : "no estimate", since),
    );
  });
}

const BADGE = { Finished: "finished", Failed: "failed", Cancelled: "cancelled" };

export function ended(view, context) {
  const scale = longest(view.ended.rows, context.now);
  return rows(view.ended, context, "Nothing has ended yet.", (row) => {
    const end = row.phases.finished === null ? null : ago(row.phases.finished, context.now);
    const open = row.open.length ? ` · not yet in ${row.open.join(", ")}` : "";
    const reason = row.reason && row.reason !== row.state ? row.reason : null;
    return element(
      "li",
      { class: "row end", "data-key": keyOf(row) },
      who(row, context),
      element("div", { class: "outcome" }, element("span", { class: `badge ${BADGE[row.state]}` }, row.state), element("span", { class: "score" }, row.score ?? "–")),
      picture(lengths(row.phases, context.now), scale),
      element("span", { class: "muted notes" }, [reason, row.total ? `${row.done}/${row.total} ${row.unit}` : null].filter(Boolean).join(" · "), open, end ? " · " : null, end),
    );
  });
}

function classes(failures) {
  const most = Math.max(1, ...failures.classes.map((each) => each.count));
  const items = failures.classes.map((each) =>
    element(
      "li",
      { class: "row class", "data-key": `${each.class}/${each.reason}` },
      element("span", { class: `badge ${each.class.toLowerCase()}` }, each.class),
      element("b", {}, each.reason),
      bar(each.count, most, `${each.reason}, ${each.class}`),
      element("span", {}, number(each.count)),
    ),
  );
  return items.length ? element("ul", { class: "classes", "aria-label": "Failures by class and reason" }, items) : null;
}

export function failures(view, context) {
  const all = { ...context, before: classes(view.failures) };
  return rows(view.failures, all, "Nothing has failed.", (row) =>
    element(
      "li",
      { class: "row fail", "data-key": keyOf(row) },
      who(row, context),
      element("p", { class: "why" }, element("b", {}, row.reason), " ", row.message),
      element("span", { class: "muted notes" }, `${row.class}, ${row.class === "Participant" ? "counts as an attempt" : "not charged"}`, row.time === null ? null : [" · ", ago(row.time, context.now)]),
    ),
  );
}

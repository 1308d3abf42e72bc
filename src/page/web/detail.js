// One submission, in the dialog over the page.

import { ago, badge, bar, bytes, element, link, number, span } from "./elements.js";
import { fault, outcome } from "./sections.js";
import { axis, steps } from "./timeline.js";

const WORKER = { Waiting: "waits", Running: "runs", Done: "done", Crashed: "crashed, starts again" };

function part(title, ...content) {
  return element("section", { "data-key": title }, element("h3", {}, title), content);
}

function copyable(text, label) {
  return element("div", { class: "copyable", "data-key": label }, element("code", {}, text), element("button", { type: "button", "data-copy": text, "aria-label": `Copy ${label}` }, "Copy"));
}

function score(row) {
  if (!row.score && !row.total) return null;
  const cell = (name, value, isFirst) => element("div", { class: isFirst ? "first" : null }, element("dt", {}, name), element("dd", {}, value));
  const so = row.score && !row.isFinal ? " so far" : "";
  return element("dl", { class: "numbers" }, row.score ? cell(`${row.score.name}${so}`, row.score.value.replace("~", ""), true) : null, row.total ? cell(row.unit, `${number(row.done)}/${number(row.total)}`) : null, row.metrics.map((metric) => cell(metric.name, metric.value)));
}

function cause(row, now) {
  if (row.failure) {
    const whose = row.failure.class === "Participant" ? "It counts as an attempt of the team." : "The team is not charged for it.";
    return element("div", { class: `cause ${fault(row.failure.class)}` }, element("p", {}, badge(fault(row.failure.class), row.failure.reason), " ", element("b", {}, row.failure.class)), element("p", {}, row.failure.message), element("p", { class: "muted" }, whose));
  }
  if (row.state !== "Pending") return null;
  const place = row.position === null ? null : [`Place ${row.position} in the queue`, row.eta ? `, starts in about ${row.eta}` : null, ". "];
  return element("div", { class: "cause" }, element("p", {}, badge("plain", row.reason ?? "New"), " ", row.since === null ? null : element("span", { class: "muted" }, "for ", span(now - row.since))), element("p", {}, place, row.message));
}

function workers(row) {
  if (!row.workers.length) return null;
  const items = row.workers.map((worker) => {
    const crashes = worker.crashes ? badge("warn", `${worker.crashes} ${worker.crashes === 1 ? "crash" : "crashes"}${worker.last ? `: ${worker.last.reason}` : ""}`) : null;
    return element("li", {}, `Worker ${worker.id}`, bar(worker.total ? worker.done / worker.total : 0, worker.state === "Done" ? "good" : worker.crashes ? "warn" : "running"), element("span", {}, `${worker.done}/${worker.total}`), element("span", { class: "muted" }, WORKER[worker.state] ?? ""), crashes);
  });
  return part("Workers", element("ul", { class: "workers" }, items));
}

function conditions(row, now) {
  const items = row.conditions.map((each) =>
    element("tr", { "data-key": each.type }, element("th", { scope: "row" }, each.type), element("td", {}, each.status), element("td", {}, element("div", {}, each.reason), each.message ? element("div", { class: "muted" }, each.message) : null), element("td", { class: "muted" }, ago(each.since, now))),
  );
  const heads = ["Type", "Status", "Reason", "Since"].map((name) => element("th", { scope: "col" }, name));
  return items.length ? part("Conditions", element("table", {}, element("thead", {}, element("tr", {}, heads)), element("tbody", {}, items))) : null;
}

function ways(row) {
  const command = (verb) => `kubectl leaderboard ${verb} ${row.name} -n ${row.namespace}`;
  const evalai = row.evalai;
  const there = evalai ? `Submission ${evalai.submission}` : null;
  return [
    part("Commands", copyable(command("why"), "the command that explains it"), copyable(command("logs"), "the command that shows its logs")),
    row.results ? part("Results in S3", copyable(row.results, "the address of the results")) : null,
    evalai ? part("EvalAI", element("p", {}, there, evalai.link ? [" in the ", link(evalai.link, "hosts' list of submissions")] : null, ".")) : null,
  ];
}

export function detail(row, now) {
  const facts = [row.track, row.leaderboard, row.attempt > 1 ? `attempt ${row.attempt}` : null, row.file === null ? null : `file (${bytes(row.file)})`, row.node ? `on ${row.node}` : null].filter(Boolean);
  const open = row.open.length ? badge("warn", `Not yet in ${row.open.join(", ")}`) : null;
  return element(
    "div",
    {},
    element("p", { class: "badges" }, outcome({ state: row.state, class: row.failure?.class }), open, element("strong", {}, row.team ?? (row.isCheck ? "Check" : null)), element("span", { class: "muted" }, facts.join(" · "))),
    cause(row, now),
    score(row),
    part("Timeline", axis(row.phases, now), steps(row.phases, now)),
    workers(row),
    ways(row),
    conditions(row, now),
  );
}

export function missing(name) {
  return element("div", {}, element("p", { class: "empty" }, `The cluster has no submission ${name} any more, or the operator may not read it. Standings keep a result after its Submission is deleted.`));
}

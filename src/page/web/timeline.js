// Where the time of a run went.

import { element, graphic, moment, span } from "./elements.js";

// A phase begins with the moment of its name, and goes on until the next moment that is known.
const PHASES = [
  ["waiting", "submitted", "Submitted"],
  ["starting", "scheduled", "Got a node"],
  ["running", "started", "Started"],
  ["publishing", "finished", "Ended"],
];

// The phases that have begun, each with its length until now at the most.
function parts(moments, now) {
  const begun = PHASES.filter(([, from]) => (moments[from] ?? null) !== null);
  return begun
    .map(([name, from, title], at) => {
      const next = begun[at + 1]?.[1] ?? "published";
      const isOver = name === "publishing" && (moments.published ?? null) === null;
      const end = isOver ? moments[from] : (moments[next] ?? now);
      return { name, title, from: moments[from], length: Math.max(0, end - moments[from]) };
    });
}

// A bar of the phases, and below it the length of each.
export function lengths(moments, now) {
  const all = parts(moments, now).filter((part) => part.length > 0);
  const names = all.map((part) => element("li", {}, element("span", { class: `dot ${part.name}` }), `${part.name} ${span(part.length)}`));
  return element("div", { class: "axis" }, bar(all), element("ul", { class: "legend", "aria-hidden": "true" }, names));
}

// A bar of the phases, with the clock at both ends.
export function axis(moments, now) {
  const all = parts(moments, now).filter((part) => part.length > 0);
  if (!all.length) return null;
  const end = moments.published ?? moments.finished ?? null;
  const sum = all.reduce((whole, part) => whole + part.length, 0);
  return element("div", { class: "axis" }, bar(all), element("p", { class: "ends", "aria-hidden": "true" }, moment(all[0].from, now), element("span", {}, span(sum)), end === null ? "now" : moment(end, now)));
}

function bar(all) {
  const sum = all.reduce((whole, part) => whole + part.length, 0);
  // The shortest phase is still seen.
  const widths = all.map((part) => Math.max(1.2, (100 * part.length) / Math.max(1, sum)));
  let x = 0;
  const rects = all.map((part, at) => {
    const rect = graphic("rect", { class: part.name, x: x.toFixed(2), width: (widths[at] - (at < all.length - 1 ? 0.5 : 0)).toFixed(2), height: 1 });
    x += widths[at];
    return rect;
  });
  const label = all.map((part) => `${part.name} ${span(part.length)}`).join(", ") || "no time yet";
  return graphic("svg", { class: "phases", viewBox: `0 0 ${Math.max(x, 1).toFixed(2)} 1`, preserveAspectRatio: "none", role: "img", "aria-label": label }, rects);
}

// The moments of a run, one below the other.
export function steps(moments, now) {
  const all = parts(moments, now);
  const isLive = (moments.finished ?? null) === null;
  const items = all.map((part, at) => {
    const goesOn = isLive && at === all.length - 1;
    const length = part.length > 0 ? `${part.name} ${span(part.length)}${goesOn ? " so far" : ""}` : null;
    return element("li", { class: goesOn ? "live" : null }, element("span", { class: `dot ${part.name}` }), element("span", {}, part.title), moment(part.from, now), element("span", { class: "muted" }, length));
  });
  if ((moments.published ?? null) !== null) {
    items.push(element("li", {}, element("span", { class: "dot publishing" }), element("span", {}, "Published in EvalAI"), moment(moments.published, now)));
  }
  return element("ol", { class: "steps" }, items);
}

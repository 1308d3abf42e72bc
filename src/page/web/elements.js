// Makes elements and brings a live tree up to date. A text of the data only ever becomes a text node or an attribute: nothing here
// parses markup, and the policy of the content forbids it.

const SVG = "http://www.w3.org/2000/svg";

function fill(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (value !== null && value !== undefined && value !== false) {
      node.setAttribute(name, value === true ? "" : String(value));
    }
  }
  for (const child of children.flat(Infinity)) {
    if (child !== null && child !== undefined && child !== false && child !== "") {
      node.append(child instanceof Node ? child : String(child));
    }
  }
  return node;
}

export function element(tag, attributes = {}, ...children) {
  return fill(document.createElement(tag), attributes, children);
}

export function graphic(tag, attributes = {}, ...children) {
  return fill(document.createElementNS(SVG, tag), attributes, children);
}

// Makes the children of `live` like those of `fresh`. What stays the same thing stays the same node, so that focus and selection
// survive: by `data-key` where there is one, else by its place.
export function update(live, fresh) {
  const keyed = new Map();
  for (const child of live.children) {
    if (child.dataset.key) keyed.set(child.dataset.key, child);
  }
  let at = live.firstChild;
  for (const next of [...fresh.childNodes]) {
    const key = next.dataset?.key;
    let same = key ? keyed.get(key) : at;
    if (key) keyed.delete(key);
    if (!same || !isAlike(same, next) || (!key && same.dataset?.key)) {
      live.insertBefore(next, at);
      continue;
    }
    if (same === at) at = at.nextSibling;
    else live.insertBefore(same, at);
    change(same, next);
  }
  while (at) {
    const gone = at;
    at = at.nextSibling;
    gone.remove();
  }
}

function isAlike(one, other) {
  return one.nodeType === other.nodeType && one.nodeName === other.nodeName;
}

function change(live, fresh) {
  if (live.nodeType === Node.TEXT_NODE) {
    if (live.data !== fresh.data) live.data = fresh.data;
    return;
  }
  for (const { name } of [...live.attributes]) {
    if (!fresh.hasAttribute(name)) live.removeAttribute(name);
  }
  for (const { name, value } of fresh.attributes) {
    if (live.getAttribute(name) !== value) live.setAttribute(name, value);
  }
  update(live, fresh);
}

// A length of time for people.
export function span(seconds) {
  const s = Math.max(0, Math.round(seconds));
  if (s < 60) return `${s} s`;
  const minutes = Math.round(s / 60);
  if (minutes < 60) return `${minutes} min`;
  const hours = Math.floor(minutes / 60);
  if (hours < 48) return minutes % 60 ? `${hours} h ${minutes % 60} min` : `${hours} h`;
  const rest = hours % 24;
  return rest ? `${Math.floor(hours / 24)} d ${rest} h` : `${hours / 24} d`;
}

// As long ago as people say it: in one unit.

export function ago(seconds, now) {
  if (seconds === null) return null;
  const at = new Date(seconds * 1000);
  return element("time", { datetime: at.toISOString(), title: at.toLocaleString("en") }, `${span(now - seconds).split(" ", 2).join(" ")} ago`);
}

// A moment of today by its clock, an older one with its date.
export function moment(seconds, now) {
  const at = new Date(seconds * 1000);
  const isToday = at.toDateString() === new Date(now * 1000).toDateString();
  const format = { hour: "2-digit", minute: "2-digit", hourCycle: "h23", ...(isToday ? {} : { month: "short", day: "numeric" }) };
  return element("time", { datetime: at.toISOString() }, at.toLocaleString("en", format));
}

export function number(count) {
  return count.toLocaleString("en");
}

// A number of bytes, rounded down.
export function bytes(count) {
  const power = [4, 3, 2, 1].find((each) => count >= 1024 ** each) ?? 0;
  return `${Math.floor(count / 1024 ** power)} ${["B", "KiB", "MiB", "GiB", "TiB"][power]}`;
}

// A bar that is filled to a share; decorative, the number stands next to it.
export function bar(share, kind = "running") {
  const width = (100 * Math.min(1, Math.max(0, share))).toFixed(2);
  return graphic("svg", { class: "meter", viewBox: "0 0 100 1", preserveAspectRatio: "none", "aria-hidden": "true" }, graphic("rect", { class: kind, width, height: 1 }));
}

// A short word on a coloured ground.
export function badge(kind, ...text) {
  return element("span", { class: `badge ${kind}` }, text);
}

// Leads to another site.
export function link(address, ...text) {
  return element("a", { href: address, target: "_blank", rel: "noopener noreferrer" }, text, element("span", { "aria-hidden": "true" }, " ↗"));
}

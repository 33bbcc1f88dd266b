"use strict";
// Everything that comes from the running system is put into the page as text, never as markup.
const SVG = "http://www.w3.org/2000/svg";
const POLL_MS = 500;
const RETRY_MS = 2000;
const WEEK_MS = 10000;
// Least height of names on the plan; in narrow rooms they shrink to the second.
const NAME_PX = 11;
const SMALL_PX = 7;
// Distances of name, probability and persons, in lines.
const LINES = [0, 1.2, 2.3];
const element = (id) => document.getElementById(id);
const made = (name, attributes, text) => {
  const node = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes || {})) node.setAttribute(key, value);
  if (text !== undefined) node.textContent = text;
  return node;
};
const html = (name, text, className) => {
  const node = document.createElement(name);
  if (text !== undefined) node.textContent = text;
  if (className) node.className = className;
  return node;
};
const percent = (p) => (p === null || p === undefined ? "–" : p >= 0.0995 || p === 0 ? `${(100 * p).toFixed(0)} %` : p >= 0.001 ? `${(100 * p).toFixed(1)} %` : "< 0.1 %");
const time = (seconds) => {
  const s = Math.max(0, Math.round(seconds));
  if (s < 60) return `${s} s`;
  if (s < 3600) return `${Math.floor(s / 60)} min` + (s % 60 ? ` ${s % 60} s` : "");
  const two = (whole, unit, rest, part) => `${whole} ${unit}` + (rest ? ` ${rest} ${part}` : "");
  if (s < 86400) return two(Math.floor(s / 3600), "h", Math.floor((s % 3600) / 60), "min");
  return two(Math.floor(s / 86400), "d", Math.floor((s % 86400) / 3600), "h");
};

// After ten minutes seconds say nothing.
const ago = (seconds) => `${time(seconds < 600 ? seconds : 60 * Math.floor(seconds / 60))} ago`;

let plan = null;
let state = null;
let paused = false;
let playing = false;
let timer = null;
let asking = false;
// A choice during a request is sent after it.
let again = false;
// 0 is the next action; 1 is now; the others are the horizons after it.
let when = 1;
let chosenTime = null;
let playedAt = 0;

const whenText = () => {
  if (when === 0) return "next action";
  const seconds = state && state.horizons_s.length ? state.horizons_s[when - 1] : 0;
  return seconds ? `in ${time(seconds)}` : "now";
};
const roomValue = (room) => (when === 0 ? room.next : room.occupied ? room.occupied[when - 1] : null);
const personValue = (person, place) => (person.rooms ? person.rooms[place][Math.max(0, when - 1)] : null);

// How strong the colour of a room is.
const warmth = (p) => 0.85 * (p || 0);

// The middle of a ring, by area.
const centre = (ring) => {
  let area = 0, x = 0, y = 0;
  for (let i = 0; i < ring.length; i++) {
    const [ax, ay] = ring[i], [bx, by] = ring[(i + 1) % ring.length];
    const cross = ax * by - bx * ay;
    area += cross; x += (ax + bx) * cross; y += (ay + by) * cross;
  }
  return area ? [x / (3 * area), y / (3 * area)] : ring[0];
};

// Where a horizontal line is in a room: pairs of ends, from left to right.
const spans = (rings, y) => {
  const ends = rings.flatMap((ring) => ring.flatMap(([ax, ay], i) => {
    const [bx, by] = ring[(i + 1) % ring.length];
    return ay > y === by > y ? [] : [ax + (y - ay) / (by - ay) * (bx - ax)];
  })).sort((a, b) => a - b);
  return ends.flatMap((x, i) => i % 2 ? [] : [[x, ends[i + 1]]]);
};

// The best place for a name of this width and height in a room: its middle, or else the widest free place.
const placeOfName = (rings, width, height) => {
  const [cx, cy] = centre(rings[0]);
  const ys = rings[0].map((p) => p[1]);
  const top = Math.min(...ys), bottom = Math.max(...ys);
  let best = { x: cx, y: cy, free: 0, worth: -Infinity };
  const STEPS = 40;
  for (let i = -1; i <= STEPS; i++) {
    const y = i < 0 ? cy - 0.5 * height : top + (bottom - top) * (i + 0.5) / STEPS;
    // Above the name, between the lines, and under the probability; better, also under the persons.
    const rows = [-0.9, 0, 1.3].map((line) => spans(rings, y + line * height));
    const under = spans(rings, y + 2.4 * height);
    for (const a of rows[0]) for (const b of rows[1]) for (const c of rows[2]) {
      const left = Math.max(a[0], b[0], c[0]), right = Math.min(a[1], b[1], c[1]);
      const free = right - left;
      if (free <= 0) continue;
      const half = Math.min(width, free) / 2;
      const x = Math.min(Math.max(cx, left + half), right - half);
      const isFree = under.some(([from, to]) => from <= x - half / 2 && x + half / 2 <= to);
      const away = Math.hypot(x - cx, y + 0.5 * height - cy) / (width + height);
      const worth = 3 * Math.min(1, free / width) + 0.5 * isFree - away;
      if (worth > best.worth) best = { x, y, free, worth };
    }
  }
  return best;
};

const drawPlan = () => {
  const svg = element("plan");
  svg.replaceChildren();
  if (!plan || !plan.rooms.length) return;
  const points = plan.rooms.flatMap((room) => room.rings.flat());
  const xs = points.map((p) => p[0]), ys = points.map((p) => p[1]);
  // Several storeys lie beside each other, with their names above them.
  const least = [Math.min(...xs), Math.min(...ys)], most = [Math.max(...xs), Math.max(...ys)];
  const size = Math.max(most[0] - least[0], most[1] - least[1], 0.1);
  const unit = size / 100, margin = 2 * unit;
  const pixel = (most[0] - least[0] + 2 * margin) / (svg.clientWidth || 800);
  const letter = Math.max(2.6 * unit, NAME_PX * pixel);
  plan.width = svg.clientWidth;
  // North is up: y is turned round.
  const at = ([x, y]) => [x - least[0], most[1] - y];
  const top = margin + (plan.storeys.length ? 1.5 * letter : 0);
  svg.setAttribute("viewBox", `${-margin} ${-top} ${most[0] - least[0] + 2 * margin} ${most[1] - least[1] + top + margin}`);
  const path = (rings) => rings.map((ring) => "M" + ring.map((p) => at(p).map((v) => v.toFixed(3)).join(" ")).join("L") + "Z").join("");
  const layers = ["floors", "heats", "things", "walls", "names"].map(() => svg.appendChild(made("g")));
  const [floors, heats, things, walls, names] = layers;
  plan.shapes = {};
  for (const room of plan.rooms) {
    const d = path(room.rings);
    floors.append(made("path", { d, "fill-rule": "evenodd", class: "floor" }));
    const known = state && state.rooms.find((own) => own.id === room.id);
    const heat = made("path", { d, "fill-rule": "evenodd", class: "heat", "fill-opacity": warmth(known ? roomValue(known) : 0) });
    heat.dataset.name = room.name;
    heats.append(heat);
    walls.append(made("path", { d, class: "wall", "stroke-width": 0.5 * unit }));
    const name = made("text", {}, room.name);
    const value = made("text", { "font-weight": "bold" });
    const who = made("text", { class: "person" });
    const robot = made("circle", { class: "robot", visibility: "hidden" });
    robot.dataset.name = "robot";
    names.append(name, value, who, robot);
    const write = (text, size) => {
      text.setAttribute("font-size", size);
      text.setAttribute("stroke-width", 0.3 * size);
      return text.getComputedTextLength ? text.getComputedTextLength() : 0;
    };
    const rings = room.rings.map((ring) => ring.map(at));
    // A small room's name is written small.
    value.textContent = "100 %";
    const wide = Math.max(write(name, letter), write(value, letter)) + 0.4 * letter, small = Math.min(letter, SMALL_PX * pixel);
    value.textContent = "";
    let size = letter, best = placeOfName(rings, wide, size);
    while (best.free < wide * size / letter && size > small) {
      size = Math.max(0.9 * size, small);
      best = placeOfName(rings, wide * size / letter, size);
    }
    const { x, y } = best;
    [name, value, who].forEach((text, i) => {
      write(text, (i === 2 ? 0.85 : 1) * size);
      text.setAttribute("x", x);
      text.setAttribute("y", y + LINES[i] * size);
    });
    for (const [key, number] of Object.entries({ cx: x, cy: y - 1.3 * size, r: 0.5 * size, "stroke-width": 0.4 * unit })) robot.setAttribute(key, number);
    plan.shapes[room.id] = { heat, value, who, robot };
  }
  for (const [x, y] of plan.doors) {
    const [cx, cy] = at([x, y]);
    walls.append(made("circle", { cx, cy, r: 0.7 * unit, class: "door", "stroke-width": 0.25 * unit }));
  }
  for (const storey of plan.storeys) {
    const [x, y] = at(storey.at);
    names.append(made("text", { x, y: y - 0.5 * letter, "font-size": letter, "stroke-width": 0.3 * letter, class: "storey" }, storey.name));
  }
  plan.dots = {};
  for (const item of plan.items) {
    const [cx, cy] = at(item.at);
    const dot = made("circle", { cx, cy, r: 0, class: "thing" });
    // A finger needs more room than a dot.
    const touch = made("circle", { cx, cy, r: 1.5 * unit, class: "touch" });
    dot.dataset.name = touch.dataset.name = item.label;
    things.append(dot, touch);
    plan.dots[item.id] = dot;
  }
  plan.unit = unit;
};

const line = (parent, text, className) => parent.append(html("span", text, className), document.createElement("br"));

const sentences = (text) => text.split(". ").map(capital).join(". ");
const capital = (text) => text.charAt(0).toUpperCase() + text.slice(1);
const roomName = (id) => (state.rooms.find((room) => room.id === id) || { name: id }).name;

// "Kitchen (99 % sure)", by the room set where there is one, or else by the likeliest place.
const whereText = (person) => {
  const at = Math.max(0, when - 1);
  if (person.sets && person.sets[at].length && person.sets[at].length <= 3) {
    const value = (id) => personValue(person, state.rooms.findIndex((room) => room.id === id));
    const set = person.sets[at].filter((id) => state.rooms.some((room) => room.id === id)).sort((a, b) => value(b) - value(a));
    const out = person.sets[at].filter((id) => !set.includes(id));
    return `${capital([...set, ...out].map(roomName).join(" or "))} (${percent(person.set_has[at])} sure)`;
  }
  const places = [...state.rooms.map((room, place) => [personValue(person, place), room.name]), [person.elsewhere[at], "out of the house"]];
  const [p, name] = places.sort((a, b) => b[0] - a[0])[0];
  return p >= 0.05 ? `${capital(name)} (${percent(p)} sure)` : "Not known";
};

// A person's next hour: a row for each likely place, darker where it is likelier.
const nextHour = (person) => {
  const horizons = state.horizons_s;
  const places = [...state.rooms.map((room, place) => [room.name, person.rooms[place]]), ["out", person.elsewhere]];
  const likely = places.filter(([, row]) => Math.max(...row) >= 0.1).sort((a, b) => b[1][0] - a[1][0]).slice(0, 4);
  const strip = html("div", undefined, "hour");
  for (const [name, row] of likely) {
    const svg = made("svg", { viewBox: "0 0 100 10", preserveAspectRatio: "none" });
    // The first minutes get as much width as the later ones: the scale is the square root of time.
    const x = (seconds) => 100 * Math.sqrt(seconds / horizons[horizons.length - 1]);
    row.forEach((p, i) => {
      const end = i + 1 < horizons.length ? x(horizons[i + 1]) : 100;
      const cell = made("rect", { x: x(horizons[i]), y: 0, width: Math.max(0, end - x(horizons[i])), height: 10, "fill-opacity": p, class: "cell" });
      cell.dataset.name = `${name}: ${percent(p)} ${horizons[i] ? `in ${time(horizons[i])}` : "now"}`;
      svg.append(cell);
    });
    strip.append(html("span", name), svg);
  }
  const scale = html("span", undefined, "scale");
  scale.append(...["now", "15 min", "1 h"].map((text) => html("span", text)));
  strip.append(html("span"), scale);
  return strip;
};

const personCard = (person) => {
  const card = html("li");
  card.append(html("strong", `${person.name}: ${person.rooms ? whereText(person) : "not known"}`));
  line(card, [...(person.rooms ? [when < 2 ? "now" : whenText()] : []), person.presence, ...person.notes].join(" · "), "dim");
  if (person.rooms && state.horizons_s.length > 1) card.append(nextHour(person));
  if (person.why) line(card, person.why, "dim");
  return card;
};

// The robot's rooms in their order: past stays, the present one, and the rooms that are left.
const planStrip = (decision) => {
  const strip = html("ol", undefined, "strip");
  decision.stays.forEach((stay, i) => {
    const next = decision.stays[i + 1];
    const item = html("li", stay.name, next ? "past" : "present");
    item.append(html("span", `${stay.works ? "" : "waits "}${next ? time(stay.ago_s - next.ago_s) : `for ${time(stay.ago_s)}`}`));
    strip.append(item);
  });
  for (const id of decision.left || []) {
    if (id !== decision.to) {
      const item = html("li", roomName(id), "left");
      item.append(html("span", "to do"));
      strip.append(item);
    }
  }
  return strip;
};

const robotCard = (decision) => {
  if (!decision) return [state.live ? "The planner has not decided yet." : "No decision until then."];
  const card = html("div");
  card.append(html("strong", decision.text), planStrip(decision));
  // The first sentence is the reason; the rest is detail.
  const end = decision.reason.search(/\.( |$)|; /);
  line(card, `${capital(end < 0 ? decision.reason : decision.reason.slice(0, end))}.`);
  if (end >= 0 && end + 2 < decision.reason.length) line(card, sentences(decision.reason.slice(end + 2).trim()), "dim");
  line(card, { "dry run": "Dry run: no robot has reported.", "on its dock": "It is on its dock.", "unknown": "Its place is unknown." }[decision.place] || `It is in ${decision.place}.`);
  const cleaned = state.rooms.filter((room) => decision.cleaned_s && room.id in decision.cleaned_s).map((room) => `${room.name} ${ago(decision.cleaned_s[room.id])}`);
  if (cleaned.length) line(card, `Last cleaned: ${cleaned.join(", ")}.`, "dim");
  if (decision.left) line(card, decision.left.length ? `Still to do: ${decision.left.map(roomName).join(", ")}.` : "Every room is done.");
  line(card, `by ${decision.policy}, ${ago(decision.age_s)}` + (decision.notes.length ? ` · ${decision.notes.join(", ")}` : ""), "dim");
  return [...card.childNodes];
};

// Names of rooms and things on hover and tap.
const showName = (event) => {
  const named = event.target.closest("[data-name]");
  const label = element("named");
  label.hidden = !named;
  if (!named) return;
  label.textContent = named.dataset.name;
  label.style.left = `${Math.min(event.pageX + 12, document.documentElement.clientWidth - label.offsetWidth - 4)}px`;
  label.style.top = `${event.pageY + 14}px`;
};

const show = () => {
  if (!state) return;
  const horizon = element("horizon");
  // Without forecasts there is no time to choose.
  if (!state.forecasts) when = 0;
  element("horizon-controls").hidden = !state.forecasts;
  element("live-controls").hidden = !state.live;
  element("orders").hidden = !state.control;
  const choice = element("order-room");
  if (choice.options.length !== state.rooms.length || state.rooms.some((room, i) => choice.options[i].textContent !== room.name)) {
    choice.replaceChildren(...state.rooms.map((room, i) => { const own = html("option", room.name); own.value = i; return own; }));
  }
  horizon.max = Math.max(1, state.horizons_s.length);
  element("horizon-text").textContent = whenText();
  horizon.setAttribute("aria-valuetext", whenText());
  element("rooms-when").textContent = when === 0 ? "occupied now" : `occupied ${whenText()}`;
  const daemon = element("daemon");
  daemon.className = state.daemon.alarm ? "alarm" : "";
  daemon.textContent = state.daemon.text;
  const at = state.decision ? state.decision.at : null;
  const body = element("rooms").tBodies[0];
  const rows = state.rooms.map((room, place) => {
    const p = roomValue(room);
    const shape = plan && plan.shapes && plan.shapes[room.id];
    const there = state.persons.filter((person) => person.likely === place).map((person) => person.name);
    if (shape) {
      shape.heat.setAttribute("fill-opacity", warmth(p));
      shape.value.textContent = percent(p);
      shape.who.textContent = there.join(", ");
      shape.heat.dataset.name = `${room.name}: ${percent(p)} ${whenText()}`;
      shape.robot.setAttribute("visibility", at === room.id ? "visible" : "hidden");
    }
    const row = html("tr");
    const head = html("th", room.name);
    head.scope = "row";
    row.append(head, html("td", percent(room.occupied ? room.occupied[Math.max(0, when - 1)] : null)), html("td", percent(room.next)));
    return row;
  });
  body.replaceChildren(...rows);
  if (plan && plan.dots) {
    const warm = element("items").checked ? state.items : {};
    const most = Math.max(0, ...Object.values(warm));
    for (const [id, dot] of Object.entries(plan.dots)) {
      const share = Object.hasOwn(warm, id) ? warm[id] : 0;
      dot.setAttribute("r", most > 0 ? 1.6 * plan.unit * Math.sqrt(share / most) : 0);
    }
  }
  const persons = state.persons.map(personCard);
  element("persons").replaceChildren(...(persons.length ? persons : [html("li", state.live ? "No person is known yet." : "No person is known then.")]));
  element("robot").replaceChildren(...robotCard(state.decision));
  const said = state.narration.map((told) => {
    const item = html("li", told.text);
    item.append(" ", html("span", `${told.who} · ${ago(told.age_s)}`, "dim"));
    return item;
  });
  element("narration").replaceChildren(...(said.length ? said : [html("li", state.live ? "No event since the view began." : "No event until then.")]));
  showQuality();
  if (!state.live) {
    element("time-controls").hidden = state.length_s === 0;
    const slider = element("time");
    slider.max = state.length_s;
    if (document.activeElement !== slider || playing) slider.value = state.at_s;
    element("time-text").textContent = `${time(state.at_s)} of ${time(state.length_s)}`;
    slider.setAttribute("aria-valuetext", element("time-text").textContent);
  }
};

const showQuality = () => {
  const box = element("quality");
  const curve = state.quality;
  if (!curve.length) {
    box.textContent = "Known when a person was observed 15 minutes after a forecast.";
    return;
  }
  const last = curve[curve.length - 1];
  const svg = made("svg", { viewBox: "0 0 100 100", preserveAspectRatio: "none", role: "img", "aria-label": "The curve of the last week, an hour a point" });
  const step = curve.length > 1 ? 100 / (curve.length - 1) : 0;
  const points = curve.map((hour, i) => `${(i * step).toFixed(2)},${(100 - 100 * hour.p).toFixed(2)}`);
  if (points.length === 1) points.push(`100,${points[0].split(",")[1]}`);
  svg.append(made("polyline", { points: points.join(" ") }));
  const text = `On average the forecast of 15 minutes before gave ${percent(last.p)} to the room where a person was then observed, in the last of ${curve.length} hours (${last.n} comparisons).`;
  box.replaceChildren(svg, html("span", text, "dim"));
};

const showWeek = (days) => {
  const share = ([room, events], all) => `${room} ${percent(events / all)}`;
  const rows = days.map((own) => {
    const all = own.rooms.reduce((sum, [, events]) => sum + events, 0);
    const rooms = own.rooms.map((room) => share(room, all)).join(", ");
    const row = html("tr");
    row.append(html("td", own.day), html("td", own.person), html("td", `${rooms} (${all} ${all === 1 ? "event" : "events"})`));
    return row;
  });
  element("week").tBodies[0].replaceChildren(...rows);
  for (const id of ["week", "week-note"]) element(id).hidden = !rows.length;
};

// The view reads the database once a minute, and not before the page is there.
const askWeek = async () => {
  if (state && state.live && !paused && !document.hidden) {
    try { showWeek(await get("week")); } catch (error) { /* The state tells. */ }
  }
};

const get = async (path, method = "GET") => {
  // The key of this start stands in the address, behind #.
  const headers = { "x-roomcast-key": location.hash.slice(1) };
  const answer = await fetch(path, { method, cache: "no-store", credentials: "omit", headers });
  if (!answer.ok) {
    const error = new Error(await answer.text());
    error.refused = answer.status === 403;
    throw error;
  }
  return answer.json();
};

// An order goes to the planner; its next decision shows the effect.
const order = async (button) => {
  const { order: kind, for: seconds } = button.dataset;
  const isOfRoom = kind === "clean" || kind === "skip";
  const query = `kind=${kind}` + (isOfRoom ? `&room=${element("order-room").value}&map=${state.map}` : "") + (seconds ? `&for=${seconds}` : "");
  const text = element("order-text");
  try {
    await get(`order?${query}`, "POST");
    text.textContent = "Sent.";
  } catch (error) {
    text.textContent = error.message;
  }
  setTimeout(() => { text.textContent = ""; }, 4000);
};

const setPlaying = (goesOn) => {
  playing = goesOn;
  const button = element("play");
  button.setAttribute("aria-pressed", playing);
  button.textContent = playing ? "Stop" : "Play";
};

const ask = async () => {
  if (asking) { again = true; return; }
  asking = true;
  again = false;
  clearTimeout(timer);
  let fault = null;
  const drawn = plan;
  try {
    if (playing && chosenTime !== null) {
      const now = performance.now();
      chosenTime = Math.min(chosenTime + (now - playedAt) / 1000, state ? state.length_s : Infinity);
      playedAt = now;
    }
    state = await get(chosenTime === null ? "state" : `state?at=${chosenTime}`);
    // A plan of another map is none.
    if (!state.map) plan = null;
    else if (!plan || plan.map !== state.map) plan = await get(`plan?map=${state.map}`);
  } catch (error) {
    fault = error.refused
      ? "This page has no key, or that of an earlier start: open the address that `roomcast view` printed when it started."
      : "No answer from `roomcast view`: start it again, and open the address that it prints.";
  }
  asking = false;
  // The recording is at its end.
  if (!fault && playing && chosenTime >= state.length_s) setPlaying(false);
  const goesOn = state && !state.live ? playing : !paused;
  // A hidden page needs no news.
  if (again) timer = setTimeout(ask, fault ? RETRY_MS : 0);
  else if ((goesOn || fault) && !document.hidden) timer = setTimeout(ask, fault ? RETRY_MS : POLL_MS);
  // Faults from here on are not faults of the connection.
  if (plan !== drawn) drawPlan();
  if (fault) {
    const daemon = element("daemon");
    daemon.className = "alarm";
    daemon.textContent = fault;
  } else {
    show();
  }
};

document.addEventListener("pointermove", showName);
document.addEventListener("click", showName);
element("orders").addEventListener("click", (event) => { if (event.target.dataset.order) order(event.target); });
element("horizon").addEventListener("input", (event) => { when = Number(event.target.value); show(); });
element("items").addEventListener("change", show);
element("pause").addEventListener("click", (event) => {
  paused = !paused;
  event.target.setAttribute("aria-pressed", paused);
  event.target.textContent = paused ? "Go on" : "Pause";
  if (!paused) ask();
});
element("time").addEventListener("input", (event) => {
  chosenTime = Number(event.target.value);
  playedAt = performance.now();
  ask();
});
element("play").addEventListener("click", () => {
  setPlaying(!playing);
  if (playing && chosenTime === null) chosenTime = 0;
  if (playing && state && chosenTime >= state.length_s) chosenTime = 0;
  playedAt = performance.now();
  ask();
});
// Letters keep their size when the window changes.
addEventListener("resize", () => {
  if (plan && plan.rooms.length && plan.width !== element("plan").clientWidth) {
    drawPlan();
    show();
  }
});
setInterval(askWeek, WEEK_MS);
document.addEventListener("visibilitychange", () => { if (!document.hidden) { playedAt = performance.now(); ask(); } });
ask();

// The operator's page. It shows what the page's process sends, and sends what the person asks: a request each, with a
// sequence number, this browser's time and, where there is one, the token.

import { Plot, drawMap, COLOURS, DASHES, DOTS } from "./draw.js";
import { PanelView } from "./panel.js";

const byId = (id) => document.getElementById(id);
const token = location.pathname.split("/")[1] || null;
const BEAT = 50; // ms between two heartbeats of whoever is in control: 300 ms without one, and the robot rests
const LOOK = 5000; // ms between two signs that somebody looks on
const HISTORY = 20; // s
const DEAD = 0.1; // of a stick's way

let socket = null, sequence = 0, hello = null, frame = null, holder = "nobody", gone = null, lost = false;
const panel = new PanelView(byId("panel"), (what, value) => send("do", { what, value: String(value) }));
let panelled = false;
let frames = [], chosen = new Set(), map = null;
const held = new Set(); // keys
const pads = { walk: [0, 0], turn: [0, 0] };
let centred = false; // the gamepad's sticks, once

// --- the line ---------------------------------------------------------------------------------------------------------

function connect() {
  const scheme = location.protocol === "https:" ? "wss:" : "ws:";
  socket = new WebSocket(`${scheme}//${location.host}${location.pathname}control`);
  socket.onmessage = (event) => hear(JSON.parse(event.data));
  socket.onopen = () => { lost = false; sequence = 0; byId("events").replaceChildren(); send("look"); banner(); };
  socket.onclose = () => { holder = "nobody"; lost = true; stand(); banner(); setTimeout(connect, 1000); };
}

function send(kind, fields = {}) {
  if (socket.readyState !== WebSocket.OPEN) return;
  const request = { kind, sequence: ++sequence, time: performance.now() / 1000, ...fields };
  if (token) request.token = token;
  socket.send(JSON.stringify(request));
}

function hear(message) {
  if (message.kind === "tick") {
    frame = message;
    remember(message);
  } else if (message.kind === "hello") {
    hello = message;
    frames = [];
    message.history.forEach(remember);
    frame = frames.at(-1) ?? null;
    begin();
  } else if (message.kind === "event") {
    addEvent(message);
  } else if (message.kind === "control") {
    holder = message.holder;
    gone = message.gone;
    byId("people").textContent = message.people === 1 ? "1 looks on" : `${message.people} look on`;
    offer(message.tasks);
    stand();
    banner();
  } else if (message.kind === "panel") {
    panelled = Boolean(message.items);
    panel.show(panelled ? message : null);
    arrange();
  } else if (message.kind === "refused") {
    byId("answer").textContent = `Refused: ${message.text}.`;
  }
}

function remember(message) {
  frames.push(message);
  while (frames.length && message.time - frames[0].time > HISTORY) frames.shift();
}

// --- what is asked ----------------------------------------------------------------------------------------------------

function way() {
  const speed = Number(byId("speed").value);
  const key = (plus, minus) => (plus.some((k) => held.has(k)) ? speed : 0) - (minus.some((k) => held.has(k)) ? speed : 0);
  const sticks = gamepad();
  const parts = [
    key(["w", "arrowup"], ["s", "arrowdown"]) - pads.walk[1] + sticks[0] + panel.pushed(),
    key(["q"], ["e"]) - pads.walk[0] + sticks[1],
    key(["a", "arrowleft"], ["d", "arrowright"]) - pads.turn[0] + sticks[2],
  ];
  return parts.map((value) => Math.max(-1, Math.min(1, Math.round(value * 1000) / 1000)));
}

function gamepad() {
  const pad = [...(navigator.getGamepads?.() ?? [])].find((one) => one?.connected && one.mapping === "standard");
  if (!pad) { centred = false; return [0, 0, 0]; }
  if (pad.buttons[1]?.pressed) send("stop");
  const stick = (value) => (Math.abs(value) < DEAD ? 0 : -Math.sign(value) * (Math.abs(value) - DEAD) / (1 - DEAD));
  const sticks = [stick(pad.axes[1]), stick(pad.axes[0]), stick(pad.axes[2])];
  centred = centred || sticks.every((value) => value === 0); // one that is held, or broken, moves nothing
  return centred ? sticks : [0, 0, 0];
}

// A machine without a graphics card may draw so slowly that signs of life come late, and a stop with them: then the
// picture goes, for numbers, map and stop to stay quick.
const SLOW = 200, SLOW_BEATS = 15; // ms that a beat is late, and how many of the last 30 may be
let beats = [], expected = performance.now();
let wanted = location.hash === "#picture"; // somebody wants to see it all the same

function beat() {
  const now = performance.now();
  if (!document.hidden) beats.push(now - expected > SLOW);
  expected = now + BEAT;
  beats = beats.slice(-30);
  if (beats.filter(Boolean).length > SLOW_BEATS && !wanted && !hello?.run?.length) flatten("This machine draws in 3D too slowly for a page that must stop a robot at once.");
  if (holder === "you") send("beat", { way: way() });
}
setInterval(beat, BEAT);
setInterval(() => send("look"), LOOK);

const typing = (event) => ["INPUT", "SELECT", "TEXTAREA"].includes(event.target?.tagName) && event.target.type !== "range";

function keyDown(event) {
  if (event.key === "Escape" || (event.key === " " && !typing(event))) {
    event.preventDefault();
    if (!event.repeat) send("stop");
  } else if (!typing(event) && !event.ctrlKey && !event.metaKey && !event.altKey) {
    held.add(event.key.toLowerCase());
    if (event.key.startsWith("Arrow")) event.preventDefault();
  }
}

function listenForKeys(target) {
  target.addEventListener("keydown", keyDown, true);
  target.addEventListener("keyup", (event) => held.delete(event.key.toLowerCase()), true);
  target.addEventListener("blur", () => held.clear());
}
listenForKeys(window);
document.addEventListener("visibilitychange", () => held.clear());

function pad(element, axes) {
  const knob = element.firstElementChild;
  const put = (x, y) => {
    axes[0] = x; axes[1] = y;
    knob.style.transform = `translate(${x * 37}px, ${y * 37}px)`;
  };
  const follow = (event) => {
    const box = element.getBoundingClientRect();
    let x = ((event.clientX - box.left) / box.width) * 2 - 1, y = ((event.clientY - box.top) / box.height) * 2 - 1;
    const far = Math.max(1, Math.hypot(x, y));
    put(x / far, y / far);
  };
  element.addEventListener("pointerdown", (event) => { element.setPointerCapture(event.pointerId); follow(event); });
  element.addEventListener("pointermove", (event) => { if (element.hasPointerCapture(event.pointerId)) follow(event); });
  for (const end of ["pointerup", "pointercancel", "lostpointercapture"]) element.addEventListener(end, () => put(0, 0));
  window.addEventListener("blur", () => put(0, 0));
}
pad(byId("pad-walk"), pads.walk);
pad(byId("pad-turn"), pads.turn);

byId("stop").onclick = byId("stop").onpointerdown = () => send("stop");
byId("off").onclick = () => send("off");
byId("rest").onclick = () => send("rest");
byId("end").onclick = () => send("end");
byId("control").onclick = () => send(holder === "you" ? "release" : "take");
byId("say").onsubmit = (event) => { event.preventDefault(); send("text", { text: byId("sentence").value }); };
byId("map").onclick = (event) => {
  if (!map) return;
  const box = event.target.getBoundingClientRect();
  send("goal", { place: map.place(event.clientX - box.left, event.clientY - box.top) });
};
byId("start").onsubmit = (event) => {
  event.preventDefault();
  const words = byId("settings").value.split(/\s+/).filter(Boolean);
  const set = Object.fromEntries(words.map((word) => [word.split("=")[0], word.split("=").slice(1).join("=")]));
  send("start", { task: byId("task").value, set, gain: Number(byId("gain").value), on: byId("record").checked });
};
byId("task").onchange = describe;

// A log that is looked back into.
let plays = true, drags = false;
byId("play").onclick = () => { plays = !plays; send("play", { on: plays }); byId("play").textContent = plays ? "Pause" : "Play"; };
byId("moment").onpointerdown = () => { drags = true; };
byId("moment").onchange = () => { drags = false; };
byId("moment").oninput = () => send("seek", { at: Number(byId("moment").value) });

// --- what is shown ----------------------------------------------------------------------------------------------------

function begin() {
  byId("robot").textContent = hello.robot;
  const run = hello.run;
  byId("run").textContent = run ? [run.title, run.policy, run.backend].filter(Boolean).join(", ") : "";
  if (!hello.history.length && !run?.length) byId("events").replaceChildren();
  byId("timeline").hidden = !run?.length;
  arrange();
  byId("skills").replaceChildren(...(run?.skills ?? []).map((text) => {
    const button = Object.assign(document.createElement("button"), { textContent: text.replaceAll("-", " "), type: "button" });
    button.onclick = () => send("skill", { text });
    return button;
  }));
  if (run?.length) byId("moment").max = run.length;
  if (byId("joints").tBodies[0].rows.length !== hello.joints.length) makeTable();
  banner();
}

function arrange() {
  const run = hello?.run;
  document.body.classList.toggle("looking-back", Boolean(run?.length));
  document.body.classList.toggle("looking-on", run?.steers === false && !panelled);
  document.body.classList.toggle("panelled", panelled);
}

function makeTable() {
  const table = byId("joints");
  table.tHead.innerHTML = "";
  const head = table.tHead.insertRow();
  ["joint", ...hello.columns.map((name, i) => (hello.units[i] ? `${name} ${hello.units[i]}` : name)), "faults"].forEach((text) => {
    head.append(Object.assign(document.createElement("th"), { textContent: text }));
  });
  const body = table.tBodies[0];
  body.innerHTML = "";
  hello.joints.forEach((name, i) => {
    const row = body.insertRow();
    for (let cell = 0; cell < hello.columns.length + 2; cell++) row.insertCell();
    row.cells[0].textContent = name;
    row.onclick = () => { chosen.has(i) ? chosen.delete(i) : chosen.add(i); mark(); };
  });
  const knees = hello.joints.map((name, i) => (name.includes("knee") ? i : -1)).filter((i) => i >= 0);
  chosen = new Set(knees.length ? knees : [0]);
  mark();
  byId("quantity").replaceChildren(
    ...hello.columns.slice(2).map((name, i) => new Option(`${name}${hello.units[i + 2] ? ", " + hello.units[i + 2] : ""}`, i + 2)),
  );
}

function mark() {
  const order = [...chosen];
  [...byId("joints").tBodies[0].rows].forEach((row, i) => {
    row.classList.toggle("chosen", chosen.has(i));
    row.style.setProperty("--colour", COLOURS[order.indexOf(i) % COLOURS.length]);
  });
}

function addEvent(message) {
  const list = byId("events");
  const text = message.joint && !message.text.includes(message.joint) ? `${message.joint}: ${message.text}` : message.text;
  const line = document.createElement("li");
  line.textContent = `${message.time.toFixed(2)} s  ${text}`;
  line.className = message.what;
  line.onclick = () => { if (hello?.run?.length) send("seek", { at: Math.max(0, message.time) }); };
  list.append(line);
  while (list.children.length > 300) list.firstChild.remove();
  list.scrollTop = list.scrollHeight;
}

function offer(tasks) {
  byId("start").hidden = !tasks.length;
  if (byId("task").options.length === tasks.length) return;
  byId("task").replaceChildren(...tasks.map((task) => Object.assign(new Option(task.name), { title: task.description })));
  describe();
}

function describe() {
  byId("description").textContent = byId("task").selectedOptions[0]?.title ?? "";
}

function stand() {
  const mine = holder === "you";
  document.body.classList.toggle("watching", !mine);
  byId("control").textContent = mine ? "Give up control" : holder === "other" ? "Somebody else is in control" : "Take control";
  byId("control").classList.toggle("held", mine);
  for (const id of ["rest", "end"]) byId(id).disabled = !mine;
  for (const id of ["skills", "panel"]) byId(id).disabled = !mine;
  for (const form of ["say", "start"]) byId(form).querySelector("button").disabled = !mine;
  if (mine) byId("answer").textContent = "";
}

function banner() {
  const bar = byId("banner"), outcome = hello?.outcome;
  let text = "", good = false;
  if (gone) text = gone + (outcome ? ` ${outcome[1]}` : "");
  else if (lost) text = "The connection is lost: this page no longer shows the robot as it is.";
  else if (outcome) { text = outcome[1]; good = outcome[0] === "succeeded"; }
  else if (frame?.why) text = `${frame.phase}: ${frame.why}`;
  bar.hidden = !text;
  bar.textContent = text;
  bar.classList.toggle("good", good);
}

function showTick() {
  const phase = byId("phase");
  if (hello.run?.length) {
    if (!drags) byId("moment").value = frame.time;
    byId("clock").textContent = `${frame.time.toFixed(2)} of ${hello.run.length.toFixed(1)} s`;
  }
  phase.textContent = hello.outcome && !hello.run?.length ? hello.outcome[0].replace("_", " ") : frame.phase;
  phase.className = `badge ${frame.phase}`;
  const parts = [
    `${frame.time.toFixed(1)} s`,
    frame.supply === null ? null : `${frame.supply.toFixed(1)} V`,
    frame.tilt === null ? null : `tilt ${frame.tilt.toFixed(0)}°`,
    `late p99 ${frame.late_p99.toFixed(1)} ms`,
    `busy p99 ${frame.busy_p99.toFixed(1)} ms`,
    `${frame.missed} missed`,
    frame.plans ? `${frame.plans} notes on plans` : null,
    frame.unread ? `${frame.unread} joint samples lost` : null,
    frame.off ? `plan off by ${(100 * frame.off[0]).toFixed(1)} cm after ${(frame.off[1] / hello.rate).toFixed(2)} s` : null,
    frame.other ? `the second: ${frame.other.phase}` : null,
    frame.contact ? hello.feet.map((name, i) => `${name} ${frame.contact[i] > 0.5 ? "●" : "○"}`).join(" ") : null,
  ];
  byId("asked").textContent = asked();
  byId("numbers").textContent = parts.filter(Boolean).join("  ·  ");
  [...byId("joints").tBodies[0].rows].forEach((row, i) => {
    hello.columns.forEach((_, column) => {
      const cell = row.cells[column + 1], value = frame.values[i][column], level = frame.levels[i][column];
      cell.textContent = value === null ? "–" : value.toFixed([3, 3, 2, 0, 1, 0, 2][column]);
      cell.className = ["", "near", "over"][level];
    });
    const faults = frame.faults[hello.joints[i]] ?? "";
    row.cells[hello.columns.length + 1].textContent = faults;
    row.cells[hello.columns.length + 1].className = faults ? "over" : "";
  });
}

function asked() {
  const part = (value) => (value < 0 ? "−" : "+") + Math.abs(value).toFixed(2);
  if (frame.text) return `“${frame.text}”`;
  if (frame.goal && frame.place) {
    const [x, y] = frame.goal, far = Math.hypot(x - frame.place[0], y - frame.place[1]);
    return `a goal ${far.toFixed(2)} m away`;
  }
  return frame.asked ? `${part(frame.asked[0])} ${part(frame.asked[1])} m/s, ${part(frame.asked[2])} rad/s` : "nothing";
}

const plots = {
  position: new Plot(byId("plot-position")), quantity: new Plot(byId("plot-quantity")),
  speed: new Plot(byId("plot-speed")), timing: new Plot(byId("plot-timing")),
};

function showPlots() {
  const order = [...chosen], column = Number(byId("quantity").value || 2), two = Boolean(frame?.other);
  const series = (get, colour, dash = null) => ({ get, colour: COLOURS[colour % COLOURS.length], dash });
  // Of two runs, the second one is dashed, in the place of targets and of what is asked.
  const both = (get, colour) => [series(get, colour), ...(two ? [series((f) => (f.other ? get(f.other) : null), colour, DASHES)] : [])];
  const with_ = (get, more, colour) => (two ? both(get, colour) : [series(get, colour), series(more, colour, DOTS)]);
  plots.position.draw(frames, HISTORY, order.flatMap((i, n) => with_((f) => f.values[i][0], (f) => f.values[i][1], n)));
  plots.quantity.draw(frames, HISTORY, order.flatMap((i, n) => both((f) => f.values[i][column], n)));
  plots.speed.draw(frames, HISTORY, [0, 1, 2].flatMap((i) => with_((f) => f.velocity?.[i] ?? null, (f) => f.asked?.[i] ?? null, i)));
  plots.timing.draw(frames, HISTORY, [...both((f) => f.late, 0), ...both((f) => f.busy, 1)]);
}

// Ten times a second is enough for a person, and leaves a slow machine time for what is asked.
let drawn = null, plotted = 0;
function show() {
  if (!hello || !frame || frame === drawn || document.hidden) return;
  drawn = frame;
  showTick();
  banner();
  map = drawMap(byId("map"), frame, hello.run);
  const now = performance.now();
  if (now - plotted > 300) { plotted = now; showPlots(); }
}

const view = byId("view");
function flatten(why) {
  view.removeAttribute("src");
  view.hidden = true;
  byId("flat").hidden = false;
  byId("flat-why").textContent = why;
}
function raise() {
  beats = [];
  view.hidden = false;
  byId("flat").hidden = true;
  view.src = "viser/";
}
view.onload = () => { try { listenForKeys(view.contentWindow); } catch { /* a page of an error, which hears no keys */ } };
byId("raise").onclick = () => { wanted = true; raise(); };
// Without WebGL viser would show nothing but an error of its own.
function draws() { return Boolean(document.createElement("canvas").getContext("webgl2")); }
if (!draws()) flatten("This browser cannot draw in 3D: it has no WebGL. Numbers, map and stop work all the same.");
else if (location.hash === "#flat") flatten("The page was opened without the picture in 3D.");
else raise();
stand();
connect();
setInterval(show, 100);

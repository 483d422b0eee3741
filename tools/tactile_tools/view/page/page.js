// The live page: receives frames, draws the newest, and reports which it has drawn.

import { Chart, colours } from "/chart.js";
import { Cupboard } from "/cupboard.js";
import { Skin } from "/skin.js";

const $ = (selector, inside = document) => inside.querySelector(selector);
const RETRY_MS = 1000;
const FULL_SIDE_N = 10; // force at which a side's bar is full
const STATE_WORDS = {
  streaming: ["streaming", "good"], gone: ["tactiled gone", "bad"], stale: ["no data", "bad"],
  unplugged: ["unplugged", "bad"], silent: ["silent", "bad"], refused: ["refused", "bad"],
  waiting: ["waiting", "wait"], identified: ["identified", "wait"],
};

let socket = null, hello = null, layout = null, frame = null, drawn = 0, due = false, requests = 0;
let colour = colours(), seeking = false, arrived = [];
const boards = new Map(), waiting = new Map();
let reachCard = null;

matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { colour = colours(); ask(); });
addEventListener("resize", ask);

// The stream

function connect() {
  if (!("WebSocket" in window)) {
    tell("This browser has no WebSocket: use a current Firefox, Chrome, Edge or Safari.");
    return;
  }
  socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/live`);
  socket.onmessage = (event) => take(JSON.parse(event.data));
  socket.onclose = () => {
    link("page server gone, trying again", "bad");
    for (const done of waiting.values()) done(false, "the connection was lost");
    waiting.clear();
    for (const card of boards.values()) card.root.toggleAttribute("data-off", true);
    setTimeout(connect, RETRY_MS);
  };
}

function take(message) {
  if (message.frame) {
    frame = message.frame;
    arrived.push(performance.now());
    while (arrived[0] < arrived.at(-1) - 2000) arrived.shift();
    remember(frame);
    ask();
  } else if (message.layout) {
    layout = message.layout;
    for (const [name, card] of boards) card.describe(layout.boards[name]);
  } else if (message.hello) {
    hello = message.hello;
    drawn = 0;
    start();
  } else if ("reply" in message) {
    waiting.get(message.reply)?.(message.ok, message.text);
    waiting.delete(message.reply);
  }
}

function start() {
  document.body.toggleAttribute("data-read-only", hello.read_only);
  $("#player").hidden = hello.log === null;
  $("#source").textContent = hello.log ?? "";
  document.title = hello.log ? `${hello.log.split("/").at(-1)} – tactile` : "tactile";
  for (const [name, points] of Object.entries(hello.history)) {
    const card = boards.get(name);
    if (card) card.chart.load(points);
  }
}

function send(what) { if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify(what)); }

function request(what, done) {
  if (socket?.readyState !== WebSocket.OPEN) { done(false, "the page's server is gone"); return; }
  waiting.set(++requests, done);
  send({ ...what, id: requests });
}

function ask() {
  if (!due) {
    due = true;
    requestAnimationFrame(() => { due = false; draw(); });
  }
}

function remember(frame) {
  for (const [name, board] of Object.entries(frame.boards))
    if (board.force && board.state === "streaming")
      boards.get(name)?.chart.add(frame.t, board.force.normal, board.force.sides);
}

// Drawing

function draw() {
  if (!frame || !layout) return;
  const names = Object.keys(frame.boards);
  for (const name of names) if (!boards.has(name)) boards.set(name, new BoardCard(name));
  for (const [name, card] of boards) if (!(name in frame.boards)) { card.root.remove(); boards.delete(name); }
  if (frame.reach && !reachCard) reachCard = new ReachCard();
  if (!frame.reach && reachCard) { reachCard.root.remove(); reachCard = null; }
  for (const name of names) boards.get(name).draw(frame.boards[name]);
  reachCard?.draw(frame.reach, Object.values(frame.boards));
  const cards = names.length + (reachCard ? 1 : 0);
  $("#main").classList.toggle("two", cards > 1);
  empty(cards);
  if (frame.log) drawPlayer(frame.log);
  const rate = arrived.length > 1 ? ((arrived.length - 1) * 1000) / (arrived.at(-1) - arrived[0]) : 0;
  if (socket?.readyState === WebSocket.OPEN) link(frame.log ? "log" : `live, ${rate.toFixed(0)} frames/s`, "good");
  if (frame.n > drawn) { drawn = frame.n; send({ ack: drawn }); }
}

function link(text, kind) { set($("#link"), text, kind); }

function empty(cards) {
  $("#empty").hidden = cards > 0;
  if (cards) return;
  if (hello?.log) tell("Nothing at this place of the log: move the slider.");
  else tell(`No board yet. Waiting for a tactiled${hello?.meets ?? ""}: start one, as in`, "tactiled --port /dev/ttyACM0");
}

function tell(text, code = "") {
  const place = $("#empty");
  place.hidden = false;
  if (place.dataset.text === text) return;
  place.dataset.text = text;
  place.textContent = text + " ";
  if (code) { const word = document.createElement("code"); word.textContent = code; place.append(word); }
}

function set(element, text, kind) {
  if (element.textContent !== text) element.textContent = text;
  if (kind !== undefined && element.dataset.kind !== kind) element.dataset.kind = kind;
}

const N = (value, digits = 2) => (value === null || value === undefined ? "–" : `${value.toFixed(digits)} N`);
const seconds = (s) => `${Math.floor(s / 60)}:${String(Math.floor(s % 60)).padStart(2, "0")}`;
const duration = (s) => (s === null ? "–" : s < 0.1 ? `${(s * 1000).toFixed(1)} ms` : `${s.toFixed(1)} s`);

class Card {
  constructor(template) {
    this.root = $(template).content.firstElementChild.cloneNode(true);
    this.cache = new Map();
  }

  get(name) {
    if (!this.cache.has(name)) this.cache.set(name, $("." + name, this.root));
    return this.cache.get(name);
  }

  say(text, kind = "", button = null) {
    const notice = this.get("notice");
    notice.hidden = !text;
    notice.textContent = text;
    notice.dataset.kind = kind;
    if (button) notice.append(button);
    clearTimeout(this.fading);
    if (text && kind !== "bad" && !text.endsWith("…")) this.fading = setTimeout(() => { notice.hidden = true; }, 12000);
  }
}

class BoardCard extends Card {
  constructor(name) {
    super("#board");
    this.name = name;
    this.root.dataset.name = name;
    this.get("name").textContent = name;
    this.chart = new Chart($(".chart canvas", this.root), layout.history_s);
    this.skin = new Skin($(".skin canvas", this.root), this.get("tip"));
    if (hello?.history[name]) this.chart.load(hello.history[name]);
    this.sides = [];
    this.get("tare").onclick = () => this.tare(false);
    this.get("record").onsubmit = (event) => { event.preventDefault(); this.record(); };
    $("form.rate", this.root).onsubmit = (event) => { event.preventDefault(); this.rate(); };
    this.get("actions").hidden = hello?.read_only ?? false;
    const before = [...document.querySelectorAll(".board")].find((each) => each.dataset.name > name);
    $("#main").insertBefore(this.root, before ?? null);
    this.describe(layout.boards[name]);
  }

  describe(shape) {
    if (!shape) return;
    this.skin.describe(shape, layout.status_bits);
    this.get("model").textContent = [shape.model, shape.serial].filter(Boolean).join(" ");
    this.sides = ["left", "right", "tip"].filter((side) => shape.arrays.some((array) => array.side === side));
    const list = this.get("sides");
    list.replaceChildren();
    if (this.sides.length > 1)
      for (const side of this.sides) {
        const row = document.createElement("div");
        row.dataset.side = side;
        row.innerHTML = '<dt></dt><span class="track"><span class="fill"></span></span><dd></dd>';
        $("dt", row).textContent = side;
        list.append(row);
      }
  }

  draw(board) {
    this.board = board;
    const live = board.state === "streaming";
    const [word, kind] = STATE_WORDS[board.state] ?? [board.state, "wait"];
    set(this.get("state"), live && !board.valid ? "streaming, not valid" : word, live && !board.valid ? "wait" : kind);
    this.root.toggleAttribute("data-off", !live);
    const reasons = this.get("reasons");
    reasons.hidden = board.reasons.length === 0;
    set(reasons, board.reasons.join("\n"));
    const force = board.force;
    const normal = this.get("normal");
    set(normal, force ? force.normal.toFixed(2) : "–");
    if (force) { normal.dataset.value = force.normal; normal.dataset.seq = force.seq; }
    set(this.get("bound"), !force ? "" : board.nominal ? "not calibrated: within a factor of two" :
      force.bound === null ? "" : `± ${force.bound.toFixed(2)} N (95 %)`);
    set(this.get("peak"), force ? `${N(force.peak)}${force.peak > 0.005 && force.peak_side !== "none" ? `, ${force.peak_side}` : ""}` : "–");
    set(this.get("tipforce"), force ? N(force.tip) : "–");
    set(this.get("contact"), force ? String(force.contact) : "–");
    set(this.get("masked"), force ? String(force.masked) : "–");
    for (const row of this.get("sides").children) {
      const value = force?.sides[row.dataset.side] ?? 0;
      set($("dd", row), force ? N(value) : "–");
      $(".fill", row).style.transform = `scaleX(${Math.min(value / FULL_SIDE_N, 1)})`;
    }
    set(this.get("rate-value"), board.rate === null ? "–" : `${board.rate.toPrecision(3)} Hz`);
    set(this.get("latency"), duration(board.latency));
    const dropped = Object.entries(board.drops).sort((a, b) => b[1] - a[1]);
    const drops = this.get("drops");
    set(drops, dropped.length ? `${dropped.reduce((n, d) => n + d[1], 0)}` : "0", dropped.length ? "warn" : "");
    drops.title = dropped.map(([why, n]) => `${n} ${why}`).join(", ");
    const field = board.ambient;
    set(this.get("field"), !field ? "–" : field.method === "off" ? "off" :
      `${Math.max(0, ...field.ut.filter((v) => v !== null)).toFixed(1)} µT${field.valid.every(Boolean) ? "" : ", held"}`);
    set(this.get("clock"), force?.uncertainty === null || !force ? "–" : `± ${duration(force.uncertainty)}`);
    set(this.get("calibration"), board.nominal === null ? "–" : board.nominal ? "nominal" : "calibrated");
    set(this.get("log"), board.log || "none", board.log && board.log !== "recording" ? "warn" : "");
    this.drawRecording(board.recording);
    // Logs of trials with exact contacts have no taxels.
    $(".skin", this.root).hidden = Boolean(frame.log) && !board.taxels;
    this.skin.draw(board.taxels, force?.sides ?? {}, colour);
    this.chart.draw(frame.t, this.sides, colour);
  }

  drawRecording(recording) {
    const form = this.get("record");
    form.toggleAttribute("data-on", recording !== null);
    const lost = recording?.dropped ? `, ${recording.dropped} dropped` : "";
    set(this.get("word"), recording ? `Stop ${seconds(recording.seconds ?? 0)}${lost}` : "Record");
    form.title = recording?.path ?? "";
  }

  tare(force) {
    const button = this.get("tare");
    button.disabled = true;
    this.say("Taring: leave the skin untouched…");
    request({ do: "tare", board: this.name, force }, (ok, text) => {
      button.disabled = false;
      if (ok || force) { this.say(text, ok ? "" : "bad"); return; }
      const again = document.createElement("button");
      again.type = "button";
      again.textContent = "Tare anyway";
      again.onclick = () => this.tare(true);
      this.say(text, "bad", text.startsWith("tare refused") ? again : null);
    });
  }

  record() {
    const stop = this.board?.recording != null;
    const button = this.get("go");
    button.disabled = true;
    const what = stop ? { do: "stop_record" } : { do: "record", name: $(".called", this.root).value };
    request({ ...what, board: this.name }, (ok, text) => {
      button.disabled = false;
      this.say(text, ok ? "" : "bad");
      if (ok && !stop) $(".called", this.root).value = "";
    });
  }

  rate() {
    const rate = parseFloat($(".hz", this.root).value);
    if (!(rate > 0)) { this.say("Give a number of samples a second above 0.", "bad"); return; }
    request({ do: "rate", board: this.name, rate_hz: rate }, (ok, text) => this.say(ok ? `Rate set to ${text}` : text, ok ? "" : "bad"));
  }
}

class ReachCard extends Card {
  constructor() {
    super("#reach");
    this.cupboard = new Cupboard($(".cupboard canvas", this.root));
    this.get("stop").onclick = () => request({ do: "stop" }, (ok, text) => this.say(text, ok ? "" : "bad"));
    this.get("actions").hidden = hello?.read_only ?? false;
    $("#main").prepend(this.root);
    this.last = 0;
  }

  draw(reach, shown) {
    const state = reach.state, arm = reach.arm;
    const old = !state || state.age > 0.5;
    this.get("stop").hidden = !state;
    if (!state) set(this.get("state"), "no reachd", "wait");
    else if (!reach.alive) set(this.get("state"), "reachd gone", "bad");
    else if (old) set(this.get("state"), "no data", "bad");
    else set(this.get("state"), state.state, state.state === "reaching" ? "good" : "");
    this.root.toggleAttribute("data-off", old);
    set(this.get("strategy"), state?.strategy ?? "");
    set(this.get("activity"), state ? (state.activity || state.state).replaceAll("_", " ") : "–");
    set(this.get("distance"), state?.distance == null ? "–" : `${(state.distance * 1000).toFixed(0)} mm`);
    set(this.get("elapsed"), state?.elapsed == null ? "–" : `${state.elapsed.toFixed(1)} s`);
    set(this.get("armforce"), N(arm?.force, 1));
    set(this.get("mode"), arm ? arm.mode : "–");
    if (!state) set(this.get("gate-state"), "unknown", "");
    else if (state.armed) set(this.get("gate-state"), state.interventions.length ? "intervening" : "passing", state.interventions.length ? "wait" : "good");
    else set(this.get("gate-state"), `holding: ${state.held || "not armed"}`.replaceAll("_", " "), "bad");
    set(this.get("interventions"), (state?.interventions ?? []).join(", ").replaceAll("_", " "));
    const newest = reach.events.at(-1)?.n ?? 0;
    if (newest !== this.last) {
      this.last = newest;
      const from = reach.events.at(-1)?.t ?? 0;
      this.get("events").replaceChildren(...reach.events.slice(-6).reverse().map((event) => {
        const item = document.createElement("li"), when = document.createElement("time"), what = document.createElement("span");
        const ago = from - event.t;
        when.textContent = ago < 0.05 ? "latest" : `−${ago.toFixed(1)} s`;
        what.textContent = `${event.kind}: ${event.code.replaceAll("_", " ")}${event.text ? ` (${event.text})` : ""}`;
        item.title = what.textContent;
        item.append(when, what);
        return item;
      }));
    }
    this.cupboard.draw(reach, shown, layout, colour);
  }
}

// Playing a log

function drawPlayer(log) {
  set($("#play"), log.paused ? "▶" : "❚❚");
  $("#play").ariaLabel = log.paused ? "Play" : "Pause";
  if (!seeking) $("#seek").value = Math.round(log.share * 1000);
  set($("#at"), `${seconds(log.at_s)} / ${seconds(log.length_s)}`);
}

$("#play").onclick = () => request({ do: frame?.log?.paused ? "play" : "pause" }, () => {});
$("#seek").oninput = (event) => { seeking = true; send({ do: "seek", share: event.target.value / 1000 }); };
$("#seek").onchange = () => { seeking = false; };
$("#speed").onchange = (event) => request({ do: "play", speed: parseFloat(event.target.value) }, () => {});

connect();

// The capture page: the live picture, the button, the presses, the last stop and its fruit.
import { Presses, post } from "./presses.js";
import drawPicture from "./picture.js";

const fill = (words, parts) => words.replace(/\{(\w+)\}/g, (_whole, name) => parts[name]);

const $ = (id) => document.getElementById(id);
const address = new URLSearchParams(location.search);
const AGAIN_MS = 1000, PICTURE_MS = 200, SILENCE_MS = 7000, CLOCK_S = 0.5;
const own = { round: address.get("round") || "", source: address.get("source") || "", home: "", watched: "", place: null, mine: null, walk: null, version: "", connected: false, simulated: null, shown: "", waiting: 0, work: "", undone: "", rows: {}, along: ["m", 1], zone_s: -60 * new Date().getTimezoneOffset() };

function show(node, words) {
  node.textContent = words;
  node.hidden = !words;
}

// ---- The time of a press, by the server's clock: a clock here that somebody sets counts for nothing.
const clock = { offset_s: Infinity, round_s: Infinity, date_s: 0 };
const now_s = () => (performance.timeOrigin + performance.now()) / 1000;

function hearClock(server_s, begun_s) {
  const ended_s = now_s(), drift_s = Date.now() / 1000 - ended_s;
  // A tablet that slept: its steady clock stood still.
  if (Math.abs(drift_s - clock.date_s) > CLOCK_S) clock.round_s = Infinity;
  clock.date_s = drift_s;
  if (ended_s - begun_s > clock.round_s) return;
  clock.round_s = ended_s - begun_s;
  clock.offset_s = (begun_s + ended_s) / 2 - server_s;
  localStorage.setItem("offset", String(clock.offset_s));
}
const serverTime_s = () => now_s() - (Number.isFinite(clock.offset_s) ? clock.offset_s : Number(localStorage.getItem("offset")) || 0);

// ---- What the server knows of the walk.
let reading = false, again = false;
async function readWalk() {
  if (reading) { again = true; return; }
  reading = true;
  const asked = new URLSearchParams({ round: own.round, source: own.source }).toString();
  try {
    const begun_s = now_s();
    const answer = await fetch(`/api/walk?${asked}`, { signal: AbortSignal.timeout(20000) });
    if (!answer.ok) {
      const { error } = await answer.json().catch(() => ({}));
      show($("told"), error || _("Not admitted: open 'Today' to log in."));
      throw new Error();
    }
    const walk = await answer.json();
    hearClock(walk.now_s, begun_s);
    // Another round or source was chosen meanwhile: `again` asks for that.
    if (asked !== new URLSearchParams({ round: own.round, source: own.source }).toString()) return;
    localStorage.setItem("walk", JSON.stringify({ ...walk, last: null }));
    showWalk(walk);
  } catch {
    const kept = JSON.parse(localStorage.getItem("walk") || "null");
    if (!own.walk && kept?.round) showWalk(kept);
    if (!own.walk) setTimeout(readWalk, AGAIN_MS);
  } finally {
    reading = false;
    if (again) { again = false; readWalk(); }
  }
}

function showWalk(walk) {
  // A round that the address names and that is not there stays named: no other one is opened.
  Object.assign(own, { walk, round: walk.missing ? own.round : walk.round, source: walk.source });
  const home = own.home;
  own.home = walk.home;
  showUnit(walk.along || own.along), own.zone_s = walk.zone_s ?? own.zone_s;
  if (`${own.round} ${walk.source} ${walk.home}` !== own.watched) {
    own.watched = `${own.round} ${walk.source} ${walk.home}`;
    history.replaceState(null, "", `/capture?${new URLSearchParams({ round: own.round, source: own.source })}`);
    for (const link of document.querySelectorAll("a[data-page]")) link.href = `/${link.dataset.page}?round=${own.round}`;
    Object.assign(own, { shown: "", simulated: null });
  }
  const none = walk.missing ? [new Option(_("Choose a round"), "", true, true)] : [];
  $("round").replaceChildren(...none, ...walk.rounds.map((one) => new Option(one.name, one.key, false, one.key === walk.round)));
  for (const name of ["camera", "replay"]) $(name).setAttribute("aria-pressed", String(own.source === name));
  if (home !== walk.home) {
    own.mine = null;
    own.rows = {};
    const kept = JSON.parse(localStorage.getItem(`place-${walk.home}`) || "null");
    // Was the last stop saved at another place since, the walk goes on from there.
    const moved = kept?.from && kept.from.key === walk.from?.key && JSON.stringify(kept.from) !== JSON.stringify(walk.from);
    const still = kept && !moved && Date.now() - kept.at < 12 * 3600e3;
    usePlace(still ? kept.place : walk.place);
  } else if (own.mine && walk.from?.key === own.mine.key && ["row", "side", "position_m"].some((name) => walk.from[name] !== own.mine[name])) {
    // Its place was corrected: the walk goes on from there.
    own.mine = walk.from;
    usePlace(walk.place);
  }
  if (walk.missing) show($("told"), _("There is no such round as this address names. Choose one, or start a new round."));
  else if (walk.home !== walk.round) show($("told"), _("These pictures are computer-made. Photos of them go into the round 'Demonstration', never into yours."));
  else if (walk.aside) show($("told"), walk.aside);
  else show($("told"), isPlaced() ? own.undone : _("Photos were lost: enter where the next stop is."));
  $("take").disabled = !walk.round || !isPlaced();
  $("rows").replaceChildren(...Object.entries(walk.rows).map(([row, on]) => new Option(`${shown(on.position_m)} ${own.along[0]}`, row)));
  $("house-name").textContent = walk.house;
  show($("doubts"), walk.doubts.length ? `${_("Check the data of this round.")} ${walk.doubts.join(". ")}.` : "");
  drawLast(walk.last, walk.first);
  drawUndo();
}

// ---- The place of the next stop, in the unit that was chosen.
// A position that is not known, as after a loss, is null; no photo is taken until somebody enters it.
const shown = (position_m) => (position_m === null ? "" : (position_m * own.along[1]).toFixed(2));
const isPlaced = () => own.place !== null && own.place.position_m !== null;

function showUnit(along) {
  if (along[0] === own.along[0]) return;
  own.along = along;
  for (const node of document.querySelectorAll(".along")) [node.textContent] = along;
  if (own.place) usePlace(own.place);
}

function usePlace(place) {
  own.place = { ...place };
  const sides = [...new Set([...(own.walk?.sides || []), place.side])];
  $("side").replaceChildren(...sides.map((side) => new Option({ left: _("Left"), right: _("Right") }[side] || side[0]?.toUpperCase() + side.slice(1), side, false, side === place.side)));
  $("row").value = place.row;
  $("position").value = shown(place.position_m);
  $("step").value = shown(place.step_m);
  $("way").value = place.back ? "back" : "onward";
  $("take").disabled = !own.walk?.round || !isPlaced();
  localStorage.setItem(`place-${own.home}`, JSON.stringify({ place, from: own.walk?.from, at: Date.now() }));
}

// Control characters, and marks that turn the writing: no name has them (names.py).
const UNSEEN = /[\p{Cc}\p{Cs}\p{Zl}\p{Zp}\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069]/gu;

// A row goes on where its last stop is; a new one begins at 0.
function placeIn(row) {
  const known = [own.rows, own.walk?.rows || {}].find((rows) => Object.hasOwn(rows, row));
  return known ? known[row] : { position_m: 0, step_m: own.place.step_m, back: false };
}

function readPlace() {
  // A field that nobody typed into keeps its place to the millimetre.
  const number = (id, known_m, most_m = Infinity) => {
    const value_m = $(id).valueAsNumber / own.along[1];
    return $(id).value !== shown(known_m) && Number.isFinite(value_m) ? Math.min(Math.max(value_m, 0), most_m) : known_m;
  };
  const row = $("row").value.replace(UNSEEN, "").trim(), typed = $("position").value !== shown(own.place.position_m);
  const place = { row, side: $("side").value, position_m: number("position", own.place.position_m), step_m: number("step", own.place.step_m, 5), back: $("way").value === "back" };
  if (row !== own.place.row && !typed) {
    const { position_m, step_m, back } = placeIn(row);
    usePlace({ ...place, position_m, step_m, back });
    return;
  }
  usePlace(place);
}

// Positions end at 0: from there a walk goes on upwards only when somebody says so.
function onward(place) {
  const at_m = place.position_m + (place.back ? -place.step_m : place.step_m);
  return { ...place, position_m: Math.max(Math.round(1000 * at_m) / 1000, 0) };
}

// ---- The button.
const presses = new Presses({
  changed: drawPresses,
  saved: (one) => {
    own.mine = one.place && { key: one.stop, ...one.place };
    if (one.stop) keepStops([...stops, { stop: one.stop, home: one.home, at_s: one.at_s }]);
    if (one.place && isPlaced() && one.place.position_m !== one.sent.position_m && !presses.waiting.length) usePlace(onward({ ...own.place, ...one.place }));
  },
  // Whether somebody walked on or back since is not known.
  lost: (some) => {
    if (!own.place || some.every((one) => one.sent.round !== own.round)) return;
    usePlace({ ...own.place, position_m: null });
    show($("told"), _("Photos were lost: enter where the next stop is."));
  },
  answered: (connected) => {
    if (own.connected === connected) return;
    own.connected = connected;
    drawWork();
  },
});
let sound = null;

// Both are switched off on this device together.
const isFelt = () => localStorage.getItem("felt") !== "no";
$("felt").setAttribute("aria-pressed", String(isFelt()));
$("felt").onclick = () => {
  localStorage.setItem("felt", isFelt() ? "no" : "yes");
  $("felt").setAttribute("aria-pressed", String(isFelt()));
};

function click() {
  if (!isFelt()) return;
  navigator.vibrate?.(40);
  try {
    sound = sound || new AudioContext();
    sound.resume();
    const length = Math.round(0.06 * sound.sampleRate);
    const buffer = sound.createBuffer(1, length, sound.sampleRate), data = buffer.getChannelData(0);
    for (let k = 0; k < length; k += 1) data[k] = (Math.random() * 2 - 1) * Math.exp(-12 * k / length);
    const source = sound.createBufferSource();
    source.buffer = buffer;
    source.connect(sound.destination);
    source.start();
  } catch { /* A browser without sound still takes pictures. */ }
}

function flash() {
  const cover = document.createElement("div");
  cover.style.cssText = "position:fixed;inset:0;background:#fff;pointer-events:none;z-index:999999";
  document.body.appendChild(cover);
  cover.animate([{ opacity: 0.85 }, { opacity: 0 }], { duration: 260, easing: "ease-out" }).onfinish = () => cover.remove();
}

function press() {
  if ($("take").disabled) return;
  const at_s = serverTime_s();
  readPlace();
  if (!isPlaced()) return;
  const { row, side, position_m } = own.place;
  presses.press({ at_s, round: own.round, source: own.source, row, side, position_m });
  usePlace(onward(own.place));
  own.rows[row] = own.place;
  own.undone = "";
  click();
  flash();
}

// At the touch, not when the finger leaves; a press of a key comes as a click without a pointer.
$("take").onpointerdown = (event) => { if (event.isPrimary && event.button === 0) press(); };
$("take").onclick = (event) => { if (event.detail === 0) press(); };
document.onkeydown = (event) => {
  if (event.key !== "Enter" && event.key !== " ") return;
  if (event.target === $("take") && event.repeat) { event.preventDefault(); return; }
  if (event.repeat || event.target.closest?.("a, button, input, select, dialog")) return;
  event.preventDefault();
  press();
};

// Presses that gave no stop, together where they are of one row and for one reason.
function lostWords(some) {
  const [{ sent, words }] = some, at_m = some.map((one) => one.sent.position_m);
  const [low, high] = [Math.min(...at_m), Math.max(...at_m)].map(shown);
  const where = [sent.row && fill(_("row {row}"), sent), { left: _("left"), right: _("right") }[sent.side] || sent.side, low === high ? `${low} ${own.along[0]}` : fill(_("{low} to {high}"), { low, high: `${high} ${own.along[0]}` })].filter(Boolean).join(", ");
  return `${fill(_("{n} lost: {where}."), { n: some.length, where })} ${words.charAt(0).toUpperCase()}${words.slice(1)}`;
}

function drawPresses() {
  const time = (one) => new Date(1000 * (one.at_s + own.zone_s)).toISOString().slice(11, 19); // the server's clock, as on every page
  const marks = { waiting: "…", saved: "✓", refused: "✗" }, groups = new Map();
  for (const one of presses.list.filter(({ state }) => state === "refused")) {
    const name = JSON.stringify([one.sent.round, one.sent.row, one.sent.side, one.words]);
    groups.set(name, [...(groups.get(name) || []), one]);
  }
  const lines = [...groups.values()].map((some) => [some[0], lostWords(some), some]);
  for (const one of presses.list.filter(({ state }) => state !== "refused").slice(-8).reverse()) {
    lines.push([one, one.state === "waiting" && !one.words ? _("waiting") : one.words]);
  }
  $("presses").replaceChildren(...lines.map(([one, text, some]) => {
    const line = document.createElement("li"), words = document.createElement("span");
    line.className = one.state;
    words.textContent = `${marks[one.state]} ${time(one)} ${text}`;
    line.append(words);
    if (some) {
      const done = document.createElement("button");
      line.setAttribute("role", "alert");
      done.type = "button";
      done.textContent = "OK";
      done.setAttribute("aria-label", `OK: ${text}`);
      done.onclick = () => presses.dismiss(some);
      line.append(done);
    }
    return line;
  }));
  drawWork();
}

function drawWork() {
  const kept = presses.waiting.length;
  $("count").textContent = kept ? fill(_("{n} waiting on this device"), { n: kept }) : own.waiting ? fill(_("{n} to be measured"), { n: own.waiting }) : _("press as fast as you walk");
  $("work").textContent = own.work;
  const lost = kept ? fill(kept === 1 ? _("Connection to the camera computer lost; {n} press is kept on this device.") : _("Connection to the camera computer lost; {n} presses are kept on this device."), { n: kept }) : _("Connection to the camera computer lost; trying again.");
  show($("lost"), own.connected ? "" : lost);
}

// ---- News and pictures, asked for again and again; pictures only while the page is seen.
const pause = (ms) => new Promise((resolve) => { setTimeout(resolve, ms); });

async function ask(path) {
  const answer = await fetch(path, { signal: AbortSignal.timeout(SILENCE_MS) });
  if (!answer.ok) throw new Error();
  return answer;
}

async function followNews() {
  for (;;) {
    let connected = true;
    try {
      const news = await (await ask(`/api/news?round=${own.home}`)).json();
      const changed = own.version !== news.version || own.waiting !== news.work.waiting;
      Object.assign(own, { version: news.version, waiting: news.work.waiting, work: news.work.words });
      if (changed) readWalk();
    } catch { connected = false; }
    if (connected && !own.connected) { readWalk(); presses.resend(); }
    own.connected = connected;
    drawWork();
    await pause(AGAIN_MS);
  }
}

async function followPreview() {
  for (;;) {
    const { source, shown } = own;
    try {
      if (document.visibilityState === "visible") {
        const answer = await ask(`/api/preview?source=${source}&shown=${shown}`);
        if (answer.status === 200 && source === own.source) await showPreview(await answer.arrayBuffer());
      }
    } catch { /* The news say so. */ }
    await pause(PICTURE_MS);
  }
}

const urls = {};
function picture(id, bytes) {
  URL.revokeObjectURL(urls[id]);
  urls[id] = URL.createObjectURL(new Blob([bytes], { type: "image/jpeg" }));
  $(id).src = urls[id];
  return $(id).decode().catch(() => {});
}

async function showPreview(bytes) {
  const length = new DataView(bytes).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(bytes, 4, length)));
  const absent = header.state === "absent";
  own.shown = header.number;
  if (absent && own.source === "camera" && !address.get("source")) {
    choose("replay");
    $("quality").textContent = _("No camera was found, so the replay is shown.");
    return;
  }
  $("absent").hidden = !absent;
  $("retry").hidden = own.source !== "camera";
  $("why").textContent = `${own.source === "camera" ? _("No camera was found.") : _("The replay cannot be shown.")} ${header.message}`;
  if (!header.color_bytes) {
    if (!absent) $("quality").textContent = _("Opening …");
    return;
  }
  const at = 4 + length + header.color_bytes;
  await Promise.all([picture("color", bytes.slice(4 + length, at)), picture("depth", bytes.slice(at))]);
  const state = { live: _("Live"), playing: _("Recording"), replay: _("Replay"), opening: _("Opening") }[header.state] || "";
  const seen = header.quality ? fill(_("Depth seen: {seen} · {distance} · {advice}"), header.quality) : _("Loading the next picture …");
  $("quality").textContent = fill(header.simulated ? _("{seen} · {state}, computer-made. Depth: {depth}.") : _("{seen} · {state}. Depth: {depth}."), { seen, state, depth: header.depth });
  if (own.simulated !== header.simulated) { own.simulated = header.simulated; readWalk(); }
}

function choose(source) {
  Object.assign(own, { source, shown: "" }); // each source numbers its own images
  readWalk();
}
for (const name of ["camera", "replay"]) $(name).onclick = () => { address.set("source", name); choose(name); };
$("swap").onclick = () => $("swap").parentElement.classList.toggle("depth");
$("retry").onclick = async () => { await post("/api/camera", {}).catch(() => {}); own.shown = ""; };

// ---- Rounds and fields.
$("round").onchange = () => { own.round = $("round").value; own.home = ""; readWalk(); };
$("begin").onclick = () => {
  $("houses").replaceChildren(...(own.walk?.houses || []).map((one) => new Option(one, one)));
  $("house").value = own.walk?.house || "";
  $("new").showModal();
};
$("house").onfocus = () => $("house").select();
$("new").onclose = async () => {
  if ($("new").returnValue !== "begin") return;
  try {
    const begun = await post("/api/rounds", { name: $("name").value, house: $("house").value });
    Object.assign(own, { round: begun.round, home: "" });
    readWalk();
  } catch (fault) { show($("told"), fill(_("The round was not started: {fault}"), { fault: fault.message })); }
};
for (const id of ["row", "side", "position", "step", "way"]) $(id).onchange = readPlace;
$("position").oninput = () => { $("take").disabled = !own.walk?.round || $("position").value === ""; };

// ---- The last stop.
let template = null, drawn = "", told = "";
async function pictureNode(capture, stop) {
  template = template || Promise.all(["picture.css", "picture.html"].map((name) => fetch(`/capture/${name}`).then((found) => found.text())));
  const [css, html] = await template, node = document.createElement("div"), root = node.attachShadow({ mode: "open" });
  root.innerHTML = `<style>${css}</style>${html}`;
  const [width, height] = capture.size;
  const data = { images: { [_("Colour")]: capture.picture }, width, height, layers: capture.layers, bar: null, tools: ["point", "box"], rulerText: "", title: _("The fruit of the last stop"), focus: null, stop: stop.key, capture: capture.name, adds: true, job: told, told };
  told = "";
  drawPicture({ data, parentElement: root, setTriggerValue: (_name, words) => { told = words; drawn = ""; readWalk(); } });
  return node;
}

function fruitTable(capture) {
  const table = document.createElement("table"), head = table.createTHead().insertRow(), body = table.createTBody();
  for (const words of [_("Fruit"), _("Length"), _("Class")]) head.append(Object.assign(document.createElement("th"), { scope: "col", textContent: words }));
  for (const one of capture.fruit) {
    const row = body.insertRow(), href = `/results?round=${own.home}&fruit=${one.key}`;
    row.insertCell().append(Object.assign(document.createElement("a"), { href, textContent: fill(_("Fruit {number}"), one) }));
    for (const words of [one.length, one.class]) row.insertCell().textContent = words;
  }
  return table;
}

function measuredWords(last) {
  const fruit = last.captures.flatMap((capture) => capture.fruit);
  return `${last.name}: ${fruit.map((one) => `${one.length} ${one.class}`).join(" · ") || _("no fruit")}`;
}

async function drawLast(last, first) {
  const text = JSON.stringify([last, first]);
  if (text === drawn) return;
  drawn = text;
  show($("fault"), last?.fault ? fill(_("Saved, but not measured: {fault}"), last) : "");
  $("measured").textContent = last ? measuredWords(last) : "";
  $("where").textContent = last ? fill(_("{stop}: saved"), { stop: last.name }) : first || _("No stops yet: each photo's result is shown here");
  $("open").hidden = !last;
  if (!last) { $("pictures").replaceChildren(); return; }
  $("open").href = `/map?round=${last.round}&stop=${last.key}`;
  const parts = [];
  for (const capture of last.captures) {
    parts.push(await pictureNode(capture, last));
    parts.push(capture.fruit.length ? fruitTable(capture) : Object.assign(document.createElement("p"), { textContent: _("No fruit was found in this photo. Tap a fruit to add it.") }));
  }
  if (text === drawn) $("pictures").replaceChildren(...parts);
}

// ---- Undo: the last thing that was done on this device in the round, a press or a correction.
const MOST_STOPS = 100;
let stops = JSON.parse(localStorage.getItem("stops") || "[]");
function keepStops(kept) {
  stops = kept.slice(-MOST_STOPS);
  localStorage.setItem("stops", JSON.stringify(stops));
  drawUndo();
}
const lastPress = () => stops.findLast((one) => one.home === own.walk?.home);
const lastIsPress = () => (lastPress()?.at_s ?? -Infinity) >= (own.walk?.done?.at_s ?? -Infinity);

function drawUndo() {
  $("undo").hidden = !lastPress() && !own.walk?.done;
  $("undo").textContent = lastIsPress() ? _("Undo the last stop") : fill(_("Undo: {action}"), { action: own.walk.done.words });
}

$("undo").onclick = async () => {
  if (presses.waiting.length) { show($("fault"), _("The last press is not saved yet: undo it when it is.")); return; }
  const pressed = lastPress(), round = own.walk.home;
  $("undo").disabled = true;
  try {
    const answer = await post("/api/undo", { round, stop: pressed?.stop || null, at_s: pressed?.at_s || null }, 90000);
    own.undone = answer.words;
    if (!answer.action) {  // the press was the last thing
      for (const one of presses.list) if (one.stop === pressed.stop) one.words = answer.words;
      own.home = "";
      localStorage.removeItem(`place-${round}`);
      keepStops(stops.filter((one) => one.stop !== pressed.stop));
    }
  } catch (fault) {
    show($("fault"), fault.message);
    // Its stop is gone: somebody deleted it elsewhere.
    if (pressed && fault.status === 409 && /not in the store/.test(fault.fault)) keepStops(stops.filter((one) => one !== pressed));
  }
  $("undo").disabled = false;
  drawPresses();
  readWalk();
};

// ---- The page itself.
navigator.serviceWorker?.register("/capture/capture-offline.js", { scope: "/capture" }).catch(() => {});
const stayAwake = () => { if (document.visibilityState === "visible") navigator.wakeLock?.request("screen").catch(() => {}); };
document.addEventListener("visibilitychange", () => { stayAwake(); if (document.visibilityState === "visible") { readWalk(); presses.resend(); } });
stayAwake();
presses.open();
readWalk();
$("take").focus({ preventScroll: true });
drawWork();
own.connected = true;
drawWork();
followNews();
followPreview();

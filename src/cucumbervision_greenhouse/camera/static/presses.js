// Presses, kept in the browser until the server has acknowledged each: a reload or a lost connection loses none.
const SHELF = "cucumbervision", PRESSES = "presses";
const TOGETHER = 50, PATIENCE_MS = 10000, AGAIN_MS = 1000, SHOWN = 6;

function opened() {
  return new Promise((resolve, reject) => {
    const asked = indexedDB.open(SHELF, 1);
    asked.onupgradeneeded = () => asked.result.createObjectStore(PRESSES, { keyPath: "number" });
    asked.onsuccess = () => resolve(asked.result);
    asked.onerror = () => reject(asked.error);
  });
}

export async function post(path, content, patience_ms = PATIENCE_MS, turn = new AbortController()) {
  const late = setTimeout(() => turn.abort(), patience_ms);
  try {
    const answer = await fetch(path, {
      method: "POST", body: JSON.stringify(content), headers: { "content-type": "application/json" }, signal: turn.signal,
    });
    if (answer.ok) return await answer.json();
    const { error, fault } = await answer.json().catch(() => ({}));
    throw Object.assign(new Error(error || _("Not admitted: open 'Today' to log in.")), { status: answer.status, fault });
  } finally {
    clearTimeout(late);
  }
}

export class Presses {
  // `changed` is called after every change; `saved` with a press that is a stop now; `lost` with those whose picture
  // is gone; `answered` with whether the server answers.
  constructor({ changed, saved, lost, answered }) {
    Object.assign(this, { changed, saved, lost, answered });
    this.list = [];
    this.made = [...crypto.getRandomValues(new Uint32Array(3))].map((part) => part.toString(36)).join("");
    this.count = 0;
    this.turn = null;
    this.again = 0;
    this.shelf = null;
  }

  async open() {
    try { this.shelf = await opened(); } catch { /* A browser that keeps nothing still takes pictures. */ }
    await this.resend();
  }

  // What another page of this browser left, which was closed before it was sent, is this one's; sent twice it is one stop.
  async adopt() {
    const kept = await new Promise((resolve, reject) => {
      const asked = this.shelf.transaction(PRESSES).objectStore(PRESSES).getAll();
      asked.onsuccess = () => resolve(asked.result);
      asked.onerror = () => reject(asked.error);
    });
    const known = new Set(this.list.map((one) => one.number));
    this.list = [...kept.filter((one) => !known.has(one.number)), ...this.list].sort((a, b) => a.at_s - b.at_s);
  }

  keep(one) {
    try { this.shelf?.transaction(PRESSES, "readwrite").objectStore(PRESSES).put(one); } catch { /* The disk is full: it is still sent. */ }
  }

  forget(one) {
    try { this.shelf?.transaction(PRESSES, "readwrite").objectStore(PRESSES).delete(one.number); } catch { /* It is sent again, and is the same stop. */ }
  }

  get waiting() { return this.list.filter((one) => one.state === "waiting"); }

  press(sent) {
    const one = { number: `${this.made}-${this.count++}`, state: "waiting", words: "", sent, at_s: sent.at_s };
    this.list.push(one);
    this.keep(one);
    this.changed();
    this.send();
  }

  dismiss(some) {
    this.list = this.list.filter((one) => !some.includes(one));
    some.forEach((one) => this.forget(one));
    this.changed();
  }

  // What was sent before a connection came back hangs until its patience ends: it is sent anew at once.
  async resend() {
    this.turn?.abort();
    try { await this.adopt(); } catch { /* Nothing is kept. */ }
    this.changed();
    this.send();
  }

  async send() {
    if (this.turn && !this.turn.signal.aborted) return;
    const turn = new AbortController();
    this.turn = turn;
    clearTimeout(this.again);
    const asked = this.waiting;
    try {
      for (let from = 0; from < asked.length; from += TOGETHER) await this.ask(asked.slice(from, from + TOGETHER), turn);
    } catch (fault) {
      if (this.turn === turn && !fault.status) this.answered(false);
    }
    if (this.turn !== turn) return;
    this.turn = null;
    this.changed();
    const waiting = this.waiting, isNew = waiting.some((one) => !asked.includes(one));
    if (waiting.length) this.again = setTimeout(() => this.send(), isNew && !turn.signal.aborted ? 0 : AGAIN_MS);
  }

  async ask(batch, turn) {
    let answer;
    try {
      answer = await post("/api/press", { presses: batch.map((one) => ({ number: one.number, ...one.sent })) }, PATIENCE_MS, turn);
    } catch (fault) {
      if (fault.status !== 400) throw fault;
      // One that is damaged costs no other.
      if (batch.length > 1) for (const one of batch) await this.ask([one], turn);
      else this.settle(batch[0], { state: "refused", words: fault.message });
      return;
    }
    if (this.turn !== turn) return;  // it is sent anew
    this.answered(true);
    answer.presses.forEach((outcome, at) => this.settle(batch[at], outcome));
    const lost = batch.filter((one) => one.lost);
    if (lost.length) this.lost(lost);
    this.changed();
  }

  settle(one, outcome) {
    if (one.state !== "waiting") return;
    Object.assign(one, outcome);
    if (one.state === "saved") {
      this.forget(one);
      this.saved(one);
    } else this.keep(one);
    const saved = this.list.filter((other) => other.state === "saved");
    for (const old of saved.slice(0, -SHOWN)) this.list.splice(this.list.indexOf(old), 1);
  }
}

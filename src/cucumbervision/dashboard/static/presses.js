// Presses, kept in the browser until the server has acknowledged each: a reload or a lost connection loses none.
const SHELF = "cucumbervision", PRESSES = "presses";
const TOGETHER = 50, PATIENCE_MS = 20000, AGAIN_MS = 1000, SHOWN = 6;

function opened() {
  return new Promise((resolve, reject) => {
    const asked = indexedDB.open(SHELF, 1);
    asked.onupgradeneeded = () => asked.result.createObjectStore(PRESSES, { keyPath: "number" });
    asked.onsuccess = () => resolve(asked.result);
    asked.onerror = () => reject(asked.error);
  });
}

export async function post(path, content, patience_ms = PATIENCE_MS) {
  const answer = await fetch(path, {
    method: "POST", body: JSON.stringify(content), headers: { "content-type": "application/json" }, signal: AbortSignal.timeout(patience_ms),
  });
  if (answer.ok) return answer.json();
  const { error } = await answer.json().catch(() => ({}));
  throw Object.assign(new Error(error || "Not admitted: open 'Today' to log in."), { status: answer.status });
}

export class Presses {
  // `changed` is called after every change; `saved` with the answer to a press that is a stop now.
  constructor(changed, saved) {
    this.changed = changed;
    this.saved = saved;
    this.list = [];
    this.made = [...crypto.getRandomValues(new Uint32Array(3))].map((part) => part.toString(36)).join("");
    this.count = 0;
    this.sending = false;
    this.shelf = null;
  }

  async open() {
    try {
      this.shelf = await opened();
      const kept = await new Promise((resolve, reject) => {
        const asked = this.shelf.transaction(PRESSES).objectStore(PRESSES).getAll();
        asked.onsuccess = () => resolve(asked.result);
        asked.onerror = () => reject(asked.error);
      });
      this.list = [...kept.sort((a, b) => a.at_s - b.at_s), ...this.list];
    } catch { /* A browser that keeps nothing still takes pictures. */ }
    this.changed();
    this.send();
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

  dismiss(one) {
    this.list = this.list.filter((other) => other !== one);
    this.forget(one);
    this.changed();
  }

  async send() {
    if (this.sending) return;
    this.sending = true;
    try {
      for (let batch; (batch = this.waiting.slice(0, TOGETHER)).length;) {
        const answer = await post("/api/press", { presses: batch.map((one) => ({ number: one.number, ...one.sent })) });
        answer.presses.forEach((outcome, at) => this.settle(batch[at], outcome));
        this.changed();
      }
    } catch (fault) {
      if (fault.status === 400) for (const one of this.waiting) this.settle(one, { state: "refused", words: fault.message });
      this.changed();
      if (this.waiting.length) setTimeout(() => this.send(), AGAIN_MS);
    } finally {
      this.sending = false;
    }
  }

  settle(one, outcome) {
    Object.assign(one, outcome);
    if (one.state === "saved") {
      this.forget(one);
      this.saved(one);
    } else this.keep(one);
    const saved = this.list.filter((other) => other.state === "saved");
    for (const old of saved.slice(0, -SHOWN)) this.list.splice(this.list.indexOf(old), 1);
  }
}

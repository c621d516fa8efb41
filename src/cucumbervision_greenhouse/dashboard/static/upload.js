// Files go to the server part by part: after a lost connection or a reload, sending goes on where it ended.
const PART = 4 * 2 ** 20, AGAIN_MS = 1000, PATIENCE_MS = 60000;
const state = new WeakMap();
const mb = (bytes) => `${(bytes / 1e6).toFixed(bytes < 1e7 ? 1 : 0)} MB`;

const left = (seconds) => seconds < 5 ? "" : seconds < 90 ? `, ${Math.round(seconds)} s left` : `, ${Math.round(seconds / 60)} min left`;

async function post(path, body) {
  const answer = await fetch(path, { method: "POST", body, signal: AbortSignal.timeout(PATIENCE_MS) });
  if (answer.ok) return answer.json();
  const { error } = await answer.json().catch(() => ({}));
  throw Object.assign(new Error(error || "Not admitted: reload the page."), { answered: true, final: answer.status < 500 });
}

async function send(files, about, tell) {
  const listed = files.map((file) => ({ name: file.name, size: file.size, changed: file.lastModified }));
  const all = files.reduce((sum, file) => sum + file.size, 0);
  for (;;) {
    const begun = Date.now();
    let first = null;  // what was there before
    try {
      const { upload, received } = await post("/api/uploads", JSON.stringify({ ...about, files: listed }));
      for (let number = 0; number < files.length; number += 1) {
        do {
          const from = received[number], part = files[number].slice(from, from + PART);
          ({ received: received[number] } = await post(`/api/uploads/${upload}/${number}?offset=${from}`, part));
          const sent = received.reduce((sum, bytes) => sum + bytes, 0);
          first ??= sent - part.size;
          const left_s = ((Date.now() - begun) / 1000) * (all - sent) / Math.max(sent - first, 1);
          tell(`Sending: ${mb(sent)} of ${mb(all)}${left(left_s)}`, sent / Math.max(all, 1));
        } while (received[number] < files[number].size);
      }
      tell("All files are sent. You may leave this page; their results appear below.", null);
      return;
    } catch (fault) {
      if (fault.final) { tell(fault.message, null); return; }
      tell(fault.answered ? `${fault.message}; sending goes on then.` : "Connection to the camera computer lost; sending goes on when it is back.", null);
      await new Promise((resolve) => { setTimeout(resolve, AGAIN_MS); });
    }
  }
}

export default function (component) {
  const { data, parentElement: root } = component;
  const own = state.get(root) || { files: [], busy: false };
  state.set(root, own);
  own.data = data;
  const [drop, input, says, bar, button] = [".drop", "input", ".says", "progress", "button"].map((name) => root.querySelector(name));
  input.accept = data.accept;
  const tell = (words, share) => {
    says.textContent = words;
    bar.hidden = share === null;
    if (share !== null) bar.value = share;
  };
  const chosen = (files) => {
    const isRecording = (file) => data.recordings.some((ending) => file.name.toLowerCase().endsWith(ending));
    const isPart = (file) => data.accept.split(",").some((ending) => file.name.toLowerCase().endsWith(ending));
    own.files = [...files].filter((file) => !isRecording(file) && isPart(file));
    const names = (which) => [...files].filter(which).map((file) => file.name).join(", ");
    const recordings = names(isRecording), ignored = names((file) => !isRecording(file) && !isPart(file));
    const besides = (recordings && ` Recordings are not sent; 'cucumbervision round add' reads them where they lie: ${recordings}.`)
      + (ignored && ` Not sent, since no part of a capture: ${ignored}.`);
    const all = own.files.reduce((sum, file) => sum + file.size, 0), most = data.limit_mb * 1e6;
    button.disabled = own.busy || !own.files.length || all > most;
    if (!own.files.length) tell(`At most ${mb(most)} at once.${besides}`, null);
    else if (all > most) tell(`${mb(all)} are more than the ${mb(most)} that are taken at once. 'Settings' has the limit.`, null);
    else tell(`${own.files.length === 1 ? "1 file" : `${own.files.length} files`}, ${mb(all)}.${besides}`, null);
  };
  input.onchange = () => chosen(input.files);
  drop.ondragover = (event) => { event.preventDefault(); drop.classList.add("over"); };
  drop.ondragleave = () => drop.classList.remove("over");
  drop.ondrop = (event) => { event.preventDefault(); drop.classList.remove("over"); chosen(event.dataTransfer.files); };
  button.onclick = async () => {
    own.busy = button.disabled = true;
    const { round, place, camera } = own.data;
    await send(own.files, { round, place, camera }, tell);
    own.busy = false;
    own.files = [];
    input.value = "";
  };
  if (!own.files.length && !own.busy && !says.textContent) chosen([]);
}

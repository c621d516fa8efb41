// Files go to the server part by part: after a lost connection or a reload, sending goes on where it ended.
const PART = 4 * 2 ** 20, AGAIN_MS = 1000, PATIENCE_MS = 60000;
const state = new WeakMap();
const mb = (bytes) => `${(bytes / 1e6).toLocaleString(_("en"), { maximumFractionDigits: bytes < 1e7 ? 1 : 0 })} MB`;
const fill = (words, parts) => words.replace(/\{(\w+)\}/g, (_whole, name) => parts[name]);
const named = (file) => file.webkitRelativePath || file.name; // colour and depth of one name lie in two folders

const left = (seconds) => seconds < 5 ? "" : ", " + (seconds < 90 ? fill(_("{s} s left"), { s: Math.round(seconds) }) : fill(_("{min} min left"), { min: Math.round(seconds / 60) }));

async function post(path, body) {
  const answer = await fetch(path, { method: "POST", body, signal: AbortSignal.timeout(PATIENCE_MS) });
  if (answer.ok) return answer.json();
  const { error } = await answer.json().catch(() => ({}));
  throw Object.assign(new Error(error || _("Not admitted: reload the page.")), { answered: true, final: answer.status < 500 });
}

async function send(files, about, tell) {
  const listed = files.map((file) => ({ name: named(file), size: file.size, changed: file.lastModified }));
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
          tell(fill(_("Sending: {sent} of {all}"), { sent: mb(sent), all: mb(all) }) + left(left_s), sent / Math.max(all, 1));
        } while (received[number] < files[number].size);
      }
      tell(_("All files are sent. You may leave this page; their results appear below."), null);
      return;
    } catch (fault) {
      if (fault.final) { tell(fault.message, null); return; }
      tell(fault.answered ? fill(_("{fault}; sending goes on then."), { fault: fault.message }) : _("Connection to the camera computer lost; sending goes on when it is back."), null);
      await new Promise((resolve) => { setTimeout(resolve, AGAIN_MS); });
    }
  }
}

export default function (component) {
  const { data, parentElement: root } = component;
  const own = state.get(root) || { files: [], busy: false };
  state.set(root, own);
  own.data = data;
  const [drop, input, files, folder, says, bar, button] = [".drop", "input", ".files", ".folder", ".says", "progress", ".measure"].map((name) => root.querySelector(name));
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
    const names = (which) => [...files].filter(which).map(named).join(", ");
    const recordings = names(isRecording), ignored = names((file) => !isRecording(file) && !isPart(file));
    const besides = ([...files].some((file) => /\.hei[cf]$/i.test(file.name)) ? _(" HEIC pictures are not read: set the phone to 'Most compatible' (JPEG).") : "")
      + (recordings && fill(_(" Recordings are not sent; 'cucumbervision round add' reads them where they lie: {names}."), { names: recordings }))
      + (ignored && fill(_(" Not sent, since no part of a capture: {names}."), { names: ignored }));
    const all = own.files.reduce((sum, file) => sum + file.size, 0), most = data.limit_mb * 1e6;
    const tooMany = own.files.length > data.limit_files, sizes = { all: mb(all), most: mb(most), n: own.files.length, limit: data.limit_files };
    button.disabled = own.busy || !own.files.length || all > most || tooMany;
    if (!own.files.length) tell(fill(_("At most {most} at once."), sizes) + besides, null);
    else if (tooMany) tell(fill(_("{n} files are more than the {limit} that are taken at once: send them in parts, or as a zip."), sizes), null);
    else if (all > most) tell(fill(_("{all} are more than the {most} that are taken at once. 'Settings' has the limit."), sizes), null);
    else tell(fill(own.files.length === 1 ? _("1 file, {all}.") : _("{n} files, {all}."), sizes) + besides, null);
  };
  input.oncancel = () => { input.webkitdirectory = false; };
  input.onchange = () => { input.webkitdirectory = false; chosen(input.files); };
  files.onclick = () => input.click();
  folder.onclick = () => { input.webkitdirectory = true; input.click(); };
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

// Lengths by hand beside the program's, a line a fruit. Its fields stay the same nodes while the page is drawn anew: a value that is
// typed meanwhile, however fast, is neither cut nor moved. Only what was typed here is sent. Enter and the arrows go to the next line.
const state = new WeakMap();
const FIELDS = [_("By hand"), _("Again")];
const number = (text) => Number(text.trim().replace(",", "."));
const isSame = (a, b) => !a === !b && Math.abs(number(a) - number(b)) < 0.006; // two digits are saved

function add(row, kind, content, name = "") {
  const node = document.createElement(kind);
  node.className = name;
  node.append(content);
  row.append(node);
}

function makeLine(line, own) {
  const row = document.createElement("tr");
  const fields = FIELDS.map((words, at) => {
    const field = Object.assign(document.createElement("input"), { inputMode: "decimal", autocomplete: "off", maxLength: 12 });
    field.setAttribute("aria-label", `${words}, ${line.name}`);
    field.onchange = () => {
      // The other field's is somebody else's, perhaps: it is sent only where it was typed here.
      own.typed[line.key] = fields.map((one, k) => (k === at ? one.value.trim() : own.typed[line.key]?.[k] ?? null));
      own.check(field);
      own.send();
    };
    field.onkeydown = (event) => {
      const step = { Enter: event.shiftKey ? -1 : 1, ArrowDown: 1, ArrowUp: -1 }[event.key];
      if (!step) return;
      event.preventDefault();
      const next = own.lines[own.lines.findIndex((other) => other.key === line.key) + step]?.fields[at];
      if (next) { next.focus(); next.select(); } else field.blur();
    };
    return field;
  });
  add(row, "td", line.picture ? Object.assign(new Image(), { src: line.picture, alt: "" }) : "");
  for (const field of fields) add(row, "td", field);
  for (const [words, name] of [[line.program, ""], [line.at, "less"], [line.row, "less"]]) add(row, "td", words, name);
  return { key: line.key, row, fields };
}

export default function (component) {
  const { data, parentElement: root, setStateValue } = component;
  const own = state.get(root) || { lines: [], made: new Map(), typed: { ...data.typed } };
  state.set(root, own);
  own.send = () => setStateValue("typed", { ...own.typed });
  own.check = (field) => {
    const value = number(field.value);
    field.setAttribute("aria-invalid", String(field.value.trim() !== "" && !(value >= data.least && value <= data.most)));
  };
  const head = root.querySelector("thead tr"), body = root.querySelector("tbody");
  if (!head.children.length) for (const [words, name] of [["", ""], [FIELDS[0], ""], [FIELDS[1], ""], [_("Program"), ""], [_("At"), "less"], [_("Row"), "less"]]) add(head, words ? "th" : "td", words, name);
  own.lines = data.lines.map((line) => {
    const made = own.made.get(line.key) || makeLine(line, own);
    own.made.set(line.key, made);
    const typed = own.typed[line.key];
    if (typed?.every((text, at) => text === null || isSame(text, line.saved[at]))) delete own.typed[line.key]; // it is saved
    made.fields.forEach((field, at) => {
      // What is being typed stays; what was saved elsewhere is shown.
      if (field !== root.activeElement) field.value = own.typed[line.key]?.[at] ?? line.saved[at];
      own.check(field);
    });
    return made;
  });
  if (own.lines.length !== body.children.length || own.lines.some(({ row }, k) => row !== body.children[k])) {
    const focused = root.activeElement;
    body.replaceChildren(...own.lines.map(({ row }) => row));
    focused?.focus();
  }
}

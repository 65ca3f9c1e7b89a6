// What a program puts beside the robot: texts, tables, buttons, sliders and what is to be filled in.

const SLIDE = 60; // ms between two requests of a slider that is held

// Shows panels in `root`; `ask(what, value)` sends what the person asks for. `pushed()` is where a springing slider is.
export class PanelView {
  constructor(root, ask) {
    this.root = root;
    this.ask = ask;
    this.shape = null;
    this.parts = [];
    this.spring = 0;
    window.addEventListener("blur", () => this.letGo());
    document.addEventListener("visibilitychange", () => this.letGo());
  }

  pushed() { return this.spring; }

  letGo() {
    this.spring = 0;
    for (const part of this.parts) part.letGo?.();
  }

  show(panel) {
    this.root.hidden = !panel;
    if (!panel) { this.shape = null; this.root.replaceChildren(); this.parts = []; return; }
    // What changes in a panel that stays is put in; else a slider would be taken out of the hand that holds it.
    const shape = JSON.stringify(panel.items, (key, value) => (["value", "text", "rows", "on"].includes(key) ? undefined : value));
    if (shape !== this.shape) {
      this.shape = shape;
      this.letGo();
      this.parts = panel.items.map((item) => this.make(item));
      this.root.replaceChildren(element("h2", {}), ...this.parts.map((part) => part.root));
    }
    this.root.firstChild.textContent = panel.title;
    panel.items.forEach((item, i) => this.parts[i].put(item));
  }

  make(item) {
    const kinds = {
      paragraph: () => this.paragraph(), table: () => this.table(item), buttons: () => this.buttons(item), slider: () => this.slider(item),
      entry: () => this.entry(item), choice: () => this.choice(item), question: () => this.question(item),
    };
    return kinds[item.is]();
  }

  paragraph() {
    const root = element("p", { className: "said" });
    return {
      root,
      put: (item) => {
        if (root.textContent === item.text) return;
        root.textContent = item.text;
        root.scrollTop = root.scrollHeight; // the newest line, which may ask for something
      },
    };
  }

  table(item) {
    const root = element("table"), body = element("tbody");
    const row = (cells, kind) => { const line = element("tr"); line.append(...cells.map((textContent) => element(kind, { textContent }))); return line; };
    const head = element("thead");
    head.append(row(item.head, "th"));
    root.append(head, body);
    return { root, put: (now) => body.replaceChildren(...now.rows.map((cells) => row(cells, "td"))) };
  }

  buttons(item) {
    const root = element("div", { className: "row" });
    const made = item.buttons.map((button) => element("button", { textContent: button.label, type: "button" }));
    root.append(...made);
    let now = item;
    made.forEach((one, i) => { one.dataset.do = item.buttons[i].do; one.onclick = () => this.ask(now.buttons[i].do, now.buttons[i].value); });
    return { root, put: (next) => { now = next; made.forEach((one, i) => { one.classList.toggle("on", next.buttons[i].on); one.dataset.value = next.buttons[i].value; }); } };
  }

  slider(item) {
    const root = element("label", { className: "slide" }), told = element("output");
    const input = element("input", { type: "range", min: item.low, max: item.high, step: (item.high - item.low) / 400 });
    input.dataset.do = item.do;
    root.append(element("span", { textContent: item.label }), input, told);
    const tell = () => { told.textContent = Number(input.value).toFixed(3); };
    if (item.springs) {
      const letGo = () => { input.value = 0; this.spring = 0; tell(); };
      input.oninput = () => { this.spring = Number(input.value); tell(); };
      for (const end of ["pointerup", "pointercancel", "lostpointercapture", "keyup", "blur", "change"]) input.addEventListener(end, letGo);
      letGo();
      return { root, put: () => {}, letGo };
    }
    let holds = false, waiting = null;
    const ask = () => { waiting = null; this.ask(item.do, input.value); };
    input.oninput = () => { holds = true; tell(); waiting ??= setTimeout(ask, SLIDE); };
    input.onchange = () => { clearTimeout(waiting); ask(); setTimeout(() => { holds = false; }, 5 * SLIDE); };
    return { root, put: (next) => { if (!holds) { input.value = next.value; tell(); } } };
  }

  entry(item) {
    const root = element("label", { className: "slide" }), input = element("input", { maxLength: 200 });
    input.dataset.do = item.do;
    root.append(element("span", { textContent: item.label }), input);
    input.onchange = () => this.ask(item.do, input.value);
    return { root, put: (next) => { if (document.activeElement !== input) input.value = next.value; } };
  }

  choice(item) {
    const root = element("label", { className: "slide" }), input = element("select");
    input.dataset.do = item.do;
    input.append(...item.options.map((text) => new Option(text, text)));
    root.append(element("span", { textContent: item.label }), input);
    input.onchange = () => this.ask(item.do, input.value);
    return { root, put: (next) => { if (document.activeElement !== input) input.value = next.value; } };
  }

  question(item) {
    const root = element("div", { className: "question" }), words = element("p");
    const answer = (textContent, yes) => {
      const button = element("button", { textContent, type: "button" });
      button.dataset.do = yes;
      button.onclick = () => { this.ask("answer", `${yes} ${item.number}`); };
      return button;
    };
    root.append(words, answer("Continue", "yes"), answer("Cancel", "no"));
    return { root, put: (next) => { words.textContent = next.text; } };
  }
}

function element(name, values = {}) { return Object.assign(document.createElement(name), values); }

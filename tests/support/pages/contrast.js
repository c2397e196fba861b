"use strict";
/* Measures the contrast of text in the controls of a page, in states that are set here: each as a person meets it. */

{
  const style = document.createElement("style");
  style.textContent = "*, *::before, *::after { transition: none !important; animation: none !important; }";
  document.head.append(style);
  for (const hidden of document.querySelectorAll(":is(main, dialog, aside, .in-sight) [hidden]:not(template, [data-attention], [data-screen])")) hidden.hidden = false;
  for (const dialog of document.querySelectorAll("dialog")) if (!dialog.open) dialog.show();
  for (const details of document.querySelectorAll("details")) details.open = true;
}

const brush = new OffscreenCanvas(1, 1).getContext("2d", { willReadFrequently: true });
const known = new Map();
function rgba(colour) {
  if (!known.has(colour)) {
    brush.clearRect(0, 0, 1, 1);
    brush.fillStyle = colour;
    brush.fillRect(0, 0, 1, 1);
    const [r, g, b, a] = brush.getImageData(0, 0, 1, 1).data;
    known.set(colour, [r, g, b, a / 255]);
  }
  return known.get(colour);
}
const over = ([r, g, b, a], under) => [r, g, b].map((value, i) => a * value + (1 - a) * under[i]);
const light = (colour) => {
  const [r, g, b] = colour.map((value) => (value / 255 <= 0.04045 ? value / 255 / 12.92 : ((value / 255 + 0.055) / 1.055) ** 2.4));
  return 0.2126 * r + 0.7152 * g + 0.0722 * b;
};
function contrast(a, b) {
  const [more, less] = [light(a), light(b)].sort((x, y) => y - x);
  return (more + 0.05) / (less + 0.05);
}
/** The colours of text and of what is behind it, with the opacity of everything around them. */
function colours(element, pseudo) {
  const text = getComputedStyle(element, pseudo);
  let [ink, ground] = [rgba(text.color), [0, 0, 0, 0]];
  for (let at = element; at; at = at.parentElement) {
    const { backgroundColor, opacity } = getComputedStyle(at);
    const layer = rgba(backgroundColor);
    const lay = (top) => { const a = top[3] + layer[3] * (1 - top[3]); return a ? [...[0, 1, 2].map((i) => (top[i] * top[3] + layer[i] * layer[3] * (1 - top[3])) / a), a] : top; };
    [ink, ground] = [lay(ink), lay(ground)];
    [ink, ground] = [ink, ground].map(([r, g, b, a]) => [r, g, b, a * Number(opacity)]);
    if (at.nodeName === "DIALOG") break; // it lies above the page
  }
  const page = over(rgba(getComputedStyle(document.documentElement).backgroundColor), [255, 255, 255]);
  return [over(ink, page), over(ground, page)];
}
function visible(element) {
  const { clipPath, visibility } = getComputedStyle(element);
  const { width, height } = element.getBoundingClientRect();
  return width > 1 && height > 1 && visibility === "visible" && clipPath === "none";
}
const CONTROLS = "button, a, summary, input:not([type=hidden], [type=radio], [type=checkbox]), select, textarea, label";
function* texts() {
  for (const control of document.querySelectorAll(CONTROLS)) {
    if (!visible(control)) continue;
    if (control.matches("input, select, textarea")) { yield [control, control]; yield [control, control, "::placeholder"]; continue; }
    for (const each of [control, ...control.querySelectorAll("*")]) {
      if (each.closest("svg") || each.closest("select, input, textarea") || !visible(each)) continue;
      if ([...each.childNodes].some((node) => node.nodeType === 3 && node.nodeValue.trim())) yield [control, each];
    }
  }
}

const STATES = {
  "as it is": () => {},
  disabled: () => { for (const e of document.querySelectorAll("button, input, select, textarea")) e.disabled = true; },
  sent: () => {
    for (const e of document.querySelectorAll("button")) {
      const sent = document.createElement("span");
      e.disabled = false;
      sent.className = "sent";
      sent.textContent = "Sent…";
      e.setAttribute("aria-disabled", "true");
      e.append(sent);
    }
  },
  held: () => { for (const e of document.querySelectorAll("button[data-hold]")) { e.disabled = false; e.classList.add("held"); } },
  "let go": () => { for (const e of document.querySelectorAll("button[data-hold]")) { e.classList.remove("held"); e.dataset.short = "yes"; } },
  chosen: () => {
    for (const e of document.querySelectorAll("[type=radio], [type=checkbox]")) e.checked = true;
    for (const name of ["aria-pressed", "aria-checked", "aria-expanded"]) for (const e of document.querySelectorAll(`[${name}]`)) e.setAttribute(name, "true");
    for (const e of document.querySelectorAll("nav a")) e.setAttribute("aria-current", "page");
  },
  wrong: () => { for (const e of document.querySelectorAll("input, select, textarea")) e.setAttribute("aria-invalid", "true"); },
  "held and disabled": () => { for (const e of document.querySelectorAll("button")) { e.classList.add("held"); e.disabled = true; } },
  offline: () => { document.body.classList.add("offline"); for (const e of document.querySelectorAll(":is(main, dialog, aside, .in-sight) :is(button, input, select, textarea)")) e.disabled = true; },
};
function unset() {
  document.body.classList.remove("offline");
  for (const e of document.querySelectorAll("button, input, select, textarea")) {
    e.disabled = false;
    e.classList.remove("held");
    for (const name of ["aria-disabled", "aria-invalid", "data-short"]) e.removeAttribute(name);
    e.querySelector(".sent")?.remove();
  }
}
/** What cannot be read: theme, state, control and figure. */
globalThis.tooFaint = (least) => {
  const found = new Set();
  for (const theme of ["light", "dark"]) {
    document.documentElement.dataset.theme = theme;
    for (const [state, set] of Object.entries(STATES)) {
      unset();
      set();
      for (const [control, element, pseudo] of texts()) {
        const figure = contrast(...colours(element, pseudo));
        if (figure >= least) continue;
        found.add(`${theme}, ${state}: ${figure.toFixed(2)} ${control.nodeName.toLowerCase()}.${control.className} ${(element.textContent || pseudo || "").trim().slice(0, 40)}`);
      }
    }
  }
  return [...found];
};

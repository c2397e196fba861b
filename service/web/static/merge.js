"use strict";
/* Brings a part of a page up to date and leaves in place what a person is at: focus, caret, typed text, opened details,
 * open forms. A form is about something: the fields that it sends besides the person's own. A form about something else
 * is another form, never the old one with a new subject under a finger or a reason that was typed for the old one. */

const merging = (() => {
  const KEPT = { DETAILS: ["open"], DIALOG: ["open"] };
  const MARKS = new Set(["data-busy", "data-offline", "data-short", "style"]);
  const OPEN = "dialog[open], details[open]:has(form)";
  const NOT_SUBJECT = ["csrf", "seen_seq"]; // who asks, and when; not about what
  const CLICK_MS = 400; // after a finger has left, until its click has come

  // --- what a person is at ------------------------------------------------------------------------------------------

  let pressed = null; // {control, form, over: time at which the press ended}
  function press(event) {
    const at = event.target instanceof Element ? event.target : null;
    pressed = { control: controlAt(at), form: at?.closest("form"), over: Infinity };
  }
  function release() { if (pressed) pressed.over = Math.min(pressed.over, performance.now()); }
  const isPressed = (form) => pressed?.form === form && performance.now() - pressed.over < CLICK_MS;
  const controlAt = (at) => at?.closest("button, a, summary") || null;
  document.addEventListener("pointerdown", press, true);
  document.addEventListener("keydown", (event) => { if (!event.repeat) press(event); }, true);
  for (const kind of ["pointerup", "pointercancel", "keyup"]) document.addEventListener(kind, release, true);
  // A finger that went down on one control does not press another one that the page has put there meanwhile.
  document.addEventListener("click", (event) => {
    const control = controlAt(event.target instanceof Element ? event.target : null);
    if (!event.detail || !control || !pressed || performance.now() - pressed.over > CLICK_MS || control === pressed.control) return;
    event.preventDefault();
    event.stopImmediatePropagation();
  }, true);

  const isOpen = (node) => node.nodeType === 1 && (node.matches(OPEN) || node.querySelector(OPEN) !== null);

  // --- merging ------------------------------------------------------------------------------------------------------

  /** What a form is about. */
  function subject(form) {
    const fields = [...form.querySelectorAll("input[type=hidden]")].filter((f) => !NOT_SUBJECT.includes(f.getAttribute("name")));
    return [form.getAttribute("action"), ...fields.map((f) => `${f.getAttribute("name")}=${f.getAttribute("value")}`)].join("\n");
  }
  const same = (a, b, name) => (a.getAttribute(name) || "") === (b.getAttribute(name) || "");
  function sameKind(a, b) {
    if (a.nodeType !== b.nodeType || a.nodeName !== b.nodeName) return false;
    if (a.nodeType !== 1) return true;
    return ["id", "name", "data-keep"].every((name) => same(a, b, name)) && a.hasAttribute("data-hold") === b.hasAttribute("data-hold")
      && (a.nodeName !== "FORM" || subject(a) === subject(b));
  }
  function merge(old, fresh) {
    if (old.nodeType !== 1) {
      if (old.nodeValue !== fresh.nodeValue) old.nodeValue = fresh.nodeValue;
      return;
    }
    if (old.matches(OPEN)) return; // somebody is writing in it
    if (old.dataset.busy === "sent") return; // its answer is awaited
    if (old.type === "hidden" && isPressed(old.form)) return; // what was read when the press began is what is sent
    const kept = KEPT[old.nodeName] || [];
    for (const { name } of [...old.attributes]) {
      if (!fresh.hasAttribute(name) && !kept.includes(name) && !MARKS.has(name)) old.removeAttribute(name);
    }
    for (const { name, value } of fresh.attributes) {
      if (!kept.includes(name) && old.getAttribute(name) !== value) old.setAttribute(name, value);
    }
    if (old.nodeName === "TEXTAREA") return;
    mergeChildren(old, fresh);
  }
  function mergeChildren(old, fresh) {
    const open = [...old.childNodes].filter(isOpen); // they stay until the person closes them, in the new content or not
    let here = old.firstChild;
    const skipTo = (end) => {
      while (here !== end) {
        const next = here.nextSibling;
        if (!open.includes(here)) here.remove();
        here = next;
      }
    };
    for (const node of [...fresh.childNodes]) {
      let match = open.find((each) => each.matches(OPEN) && sameKind(each, node));
      if (match && !(here && (here === match || here.compareDocumentPosition(match) & Node.DOCUMENT_POSITION_FOLLOWING))) continue;
      // Nodes before it may have been inserted or removed: look a little further.
      match ||= here;
      for (let i = 0; match && i < 8 && !sameKind(match, node); i += 1) match = match.nextSibling;
      if (match && sameKind(match, node)) {
        skipTo(match);
        merge(match, node);
        here = match.nextSibling;
      } else {
        old.insertBefore(node.cloneNode(true), here);
      }
    }
    skipTo(null);
  }
  return { mergeChildren, OPEN };
})();

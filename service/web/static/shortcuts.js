// Keyboard shortcuts, with their list under "?". None of them lets the robot move: that takes a held button or the pedal.
// They wait a moment, so that a badge reader or a scanner, which types by itself, triggers none.
"use strict";

(() => {
  const KEY = "orthocapture-shortcuts";
  const ALONE_MS = 90; // a person's next key comes later
  const PREFIX_MS = 1500;
  const help = document.getElementById("shortcuts");
  const choice = help.querySelector("[data-shortcuts-on]");
  const isOn = () => localStorage.getItem(KEY) !== "off";
  choice.checked = isOn();
  choice.addEventListener("change", () => localStorage.setItem(KEY, choice.checked ? "on" : "off"));
  document.addEventListener("click", (event) => { if (event.target.closest("[data-shortcuts]")) help.showModal(); });

  const first = (selector) => [...document.querySelectorAll(selector)].find((e) => e.checkVisibility() && !e.disabled);
  const press = (selector) => first(selector)?.click();
  const focus = (selector) => { const found = first(selector); found?.focus(); found?.scrollIntoView({ block: "nearest" }); };
  const open = (end) => { const tab = [...document.querySelectorAll("nav[aria-label='This run'] a")].find((a) => end.test(a.pathname)); if (tab) location.assign(tab.href); };
  const ACTS = {
    "?": () => help.showModal(),
    p: () => press(".part-actions .pause, .banner-pause button"),
    m: () => focus("a.main-action, .main-action button"),
    n: () => focus(".check[aria-checked=false]"),
    e: () => press(".actions [data-dialog=dialog-abort]"),
    r: () => press(".actions [data-dialog=dialog-redo]"),
    s: () => press(".actions [data-dialog=dialog-skip]"),
    a: () => press(".actions [data-dialog=dialog-accept]"),
    k: () => press(".lock-form button"),
    l: () => press("[data-live-start], [data-live-stop]"),
    f: () => press("[data-live-peaking]"),
    x: () => press("[data-live-times]"),
    "+": () => press("[data-zoom=in]"),
    "-": () => press("[data-zoom=out]"),
    0: () => press("[data-zoom=whole]"),
  };
  const PLACES = {
    r: () => location.assign("/"),
    s: () => open(/^\/runs\/[^/]+$/),
    c: () => open(/\/capture$/),
    v: () => open(/\/scene$/),
    k: () => open(/\/calibration$/),
    a: () => open(/^\/audit\//),
  };
  const types = (e) => e.matches?.("textarea, select, [contenteditable], input:not([type=checkbox], [type=radio], [type=button])");
  let waiting = 0;
  let keyAt = -Infinity; // by the events' own times: a busy page runs its timers late
  let prefixAt = -Infinity;
  document.addEventListener("keydown", (event) => {
    const alone = event.timeStamp - keyAt > ALONE_MS;
    keyAt = event.timeStamp;
    clearTimeout(waiting);
    if (!isOn() || event.ctrlKey || event.metaKey || event.altKey || event.repeat || event.defaultPrevented) return;
    if (types(event.target) || document.querySelector("dialog:modal")) return;
    const key = event.key.length === 1 ? event.key.toLowerCase() : "";
    const to = performance.now() - prefixAt < PREFIX_MS;
    const act = to ? PLACES[key] : ACTS[key];
    prefixAt = -Infinity;
    if (!alone || !(act || key === "g")) return;
    waiting = setTimeout(() => {
      if (act) act();
      else prefixAt = performance.now();
    }, ALONE_MS);
  });
  document.addEventListener("click", (event) => { if (event.target.closest("[data-print]")) window.print(); });
})();

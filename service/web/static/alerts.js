"use strict";
/* Signals by sound and notification that a run stops, waits or ends, on screens where alerts are switched on. The title
 * of the page says it on every screen. */

(() => {
  const KEY = "orthocapture-alerts";
  const WORDS = { waits: "Waits", stopped: "Stopped", ended: "Ended" };
  const TONES = { waits: [660, 880], stopped: [880, 440, 880, 440], ended: [440, 550, 660] }; // Hz
  const TONE_S = 0.22;
  const button = document.getElementById("alerts");
  const loaded = document.title;
  const named = () => document.querySelector("[data-title]")?.dataset.title; // the step may be another one by now
  const first = named();
  const titled = () => (first && named() ? loaded.replace(first, named()) : loaded);
  let audio = null;
  const chosen = () => localStorage.getItem(KEY) === "on";
  const standings = () => new Map([...document.querySelectorAll("[data-attention]")].map((e) => [e.dataset.of, [e.dataset.attention, e.dataset.words]]));
  let known = standings();

  function show() {
    button.hidden = false;
    button.setAttribute("aria-pressed", String(chosen()));
  }
  function beep(standing) {
    audio ||= new AudioContext();
    audio.resume();
    TONES[standing].forEach((hertz, i) => {
      const [from, tone, gain] = [audio.currentTime + i * TONE_S, audio.createOscillator(), audio.createGain()];
      tone.frequency.value = hertz;
      gain.gain.setValueAtTime(0.25, from);
      gain.gain.linearRampToValueAtTime(0, from + TONE_S);
      tone.connect(gain).connect(audio.destination);
      tone.start(from);
      tone.stop(from + TONE_S);
    });
  }
  function notify(run, standing, words) {
    if (!("Notification" in window) || Notification.permission !== "granted") return;
    const note = new Notification(`${WORDS[standing]}: ${words}`, { body: `Run ${run}`, tag: run });
    note.addEventListener("click", () => { window.focus(); location.assign(`/runs/${run}`); });
  }
  function follow() {
    const now = standings();
    for (const [run, [standing, words]] of now) {
      const [was, before] = known.get(run) || [];
      if (standing === "works" || (standing === was && words === before) || !chosen()) continue;
      beep(standing);
      notify(run, standing, words);
    }
    known = now;
    const told = [...now.values()].find(([standing]) => standing === "stopped") || [...now.values()].find(([standing]) => standing === "waits");
    document.title = told ? `${WORDS[told[0]]}: ${told[1]} · ${titled()}` : titled();
  }
  button.addEventListener("click", async () => {
    localStorage.setItem(KEY, chosen() ? "off" : "on");
    show();
    if (!chosen()) return;
    beep("waits"); // so that it is known how it sounds, and that it does
    if ("Notification" in window && Notification.permission === "default") await Notification.requestPermission();
  });
  document.addEventListener("page-changed", follow);
  show();
  follow();
})();

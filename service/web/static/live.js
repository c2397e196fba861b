// The camera's live view, for focusing: a magnifier, sharp edges marked, a histogram, and the sharpness compared with the
// best so far. All of it is computed here from the frames; nothing is recorded.
"use strict";

(() => {
  const panel = document.querySelector("[data-live]");
  if (!panel) return;
  const one = (name) => panel.querySelector(`[data-live-${name}]`);
  const start = one("start");
  const stop = one("stop");
  const view = one("view");
  const picture = view.querySelector("img");
  const marks = one("marks");
  const loupe = one("loupe");
  const histogram = one("histogram");
  const word = view.querySelector(".live-word");
  const EVERY_MS = 500;
  const EDGE = 56; // of 510: neighbours that differ by more are marked as a sharp edge
  const LOUPES = [2, 4, 8];
  const BARS = 128;
  let open = false;
  let shown = "";
  let times = 4;
  let peaking = true;
  let at = { x: 0.5, y: 0.5 }; // what is magnified, as shares of the frame
  let best = 0;
  let camera = ""; // whose frames; "": the first one
  let frame = null; // the newest: width, height, luma

  const say = (text) => { if (word.textContent !== text) word.textContent = text; };
  const source = document.createElement("canvas");

  function read() {
    source.width = picture.naturalWidth;
    source.height = picture.naturalHeight;
    const context = source.getContext("2d", { willReadFrequently: true });
    context.drawImage(picture, 0, 0);
    const { data, width, height } = context.getImageData(0, 0, source.width, source.height);
    const luma = new Uint8ClampedArray(width * height);
    for (let i = 0; i < luma.length; i += 1) luma[i] = 0.2126 * data[4 * i] + 0.7152 * data[4 * i + 1] + 0.0722 * data[4 * i + 2];
    frame = { width, height, luma };
  }
  /** The part of the frame that the magnifier shows, in pixels of the frame. */
  function region() {
    const { width, height } = frame;
    const w = Math.min(Math.round(loupe.width / times), width);
    const h = Math.min(Math.round(loupe.height / times), height);
    const within = (share, size, part) => Math.round(Math.min(Math.max(share * size - part / 2, 0), size - part));
    return { x: within(at.x, width, w), y: within(at.y, height, h), w, h };
  }
  function edge(i) {
    const { luma, width } = frame;
    return Math.abs(luma[i + 1] - luma[i - 1]) + Math.abs(luma[i + width] - luma[i - width]);
  }
  function drawMarks() {
    const { width, height } = frame;
    marks.width = width;
    marks.height = height;
    const context = marks.getContext("2d");
    let found = 0;
    if (peaking) {
      const over = context.createImageData(width, height);
      for (let y = 1; y < height - 1; y += 1) {
        for (let x = 1; x < width - 1; x += 1) {
          const i = y * width + x;
          if (edge(i) < EDGE) continue;
          over.data.set([255, 40, 40, 255], 4 * i);
          found += 1;
        }
      }
      context.putImageData(over, 0, 0);
    }
    marks.dataset.found = String(found);
    const { x, y, w, h } = region();
    context.strokeStyle = "#fff";
    context.lineWidth = Math.max(1, width / 400);
    context.strokeRect(x, y, w, h);
    context.strokeStyle = "#000";
    context.setLineDash([width / 100, width / 100]);
    context.strokeRect(x, y, w, h);
  }
  function drawLoupe() {
    const { x, y, w, h } = region();
    const context = loupe.getContext("2d");
    context.imageSmoothingEnabled = false;
    context.clearRect(0, 0, loupe.width, loupe.height);
    context.drawImage(source, x, y, w, h, 0, 0, w * times, h * times);
  }
  /** Energy of the fine edges in the magnified part, relative to its brightness: largest when the lens is focused. */
  function tellSharpness() {
    const { x, y, w, h } = region();
    const { luma, width, height } = frame;
    let energy = 0;
    let light = 0;
    let count = 0;
    for (let row = Math.max(y, 1); row < Math.min(y + h, height - 1); row += 1) {
      for (let column = Math.max(x, 1); column < Math.min(x + w, width - 1); column += 1) {
        const i = row * width + column;
        energy += (4 * luma[i] - luma[i - 1] - luma[i + 1] - luma[i - width] - luma[i + width]) ** 2;
        light += luma[i];
        count += 1;
      }
    }
    const sharpness = Math.sqrt(energy / count) / Math.max(light / count, 1);
    best = Math.max(best, sharpness);
    const percent = best ? Math.round((100 * sharpness) / best) : 0;
    one("sharpness").value = percent;
    one("figure").textContent = `${percent} %`;
  }
  function drawHistogram() {
    const { luma } = frame;
    const bars = new Uint32Array(BARS);
    let sum = 0;
    let clipped = 0;
    for (const value of luma) {
      bars[(value * BARS) >> 8] += 1;
      sum += value;
      if (value >= 254) clipped += 1;
    }
    const context = histogram.getContext("2d");
    const { width, height } = histogram;
    context.clearRect(0, 0, width, height);
    context.fillStyle = getComputedStyle(histogram).color;
    const most = Math.sqrt(Math.max(...bars)); // by the root: small amounts at the ends are seen
    bars.forEach((count, i) => {
      const tall = most ? (Math.sqrt(count) / most) * height : 0;
      context.fillRect((i * width) / BARS, height - tall, width / BARS, tall);
    });
    const share = (100 * clipped) / luma.length;
    one("light").textContent = `Mean ${Math.round(sum / luma.length)} of 255; ${share.toFixed(1)} % at the white end`;
  }
  function draw() {
    if (!frame) return;
    drawMarks();
    drawLoupe();
    drawHistogram();
    tellSharpness();
  }

  // Clears what was computed for the camera shown before.
  function forget() {
    frame = null;
    [marks, loupe, histogram].forEach((canvas) => canvas.getContext("2d").clearRect(0, 0, canvas.width, canvas.height));
    one("sharpness").value = 0;
    one("figure").textContent = "–";
    one("light").textContent = "";
  }

  async function next() {
    if (!open) return;
    const began = performance.now();
    const asked = camera;
    try {
      const response = await fetch(`${panel.dataset.live}?camera=${encodeURIComponent(asked)}`, { cache: "no-store" });
      const content = response.status === 200 ? await response.blob() : null;
      if (asked !== camera) {
        // Another camera was chosen meanwhile: this frame is not from it.
      } else if (content) {
        const address = URL.createObjectURL(content);
        picture.src = address;
        await picture.decode();
        if (shown) URL.revokeObjectURL(shown);
        shown = address;
        if (asked === camera) {
          view.classList.remove("without-frame");
          read();
          draw();
          say("Live");
        }
      } else {
        view.classList.add("without-frame");
        say(response.status === 204 ? "No frame yet: the camera is busy, or no capture runs." : "No frames: the run or the sign-in has ended.");
      }
    } catch {
      view.classList.add("without-frame");
      say("Connection lost – the capture goes on.");
    }
    setTimeout(next, Math.max(100, EVERY_MS - (performance.now() - began)));
  }

  function set(now) {
    open = now;
    view.hidden = !now;
    start.hidden = now;
    stop.hidden = !now;
    best = 0;
    if (now) {
      next();
      panel.scrollIntoView({ block: "start", behavior: "instant" });
    }
    (now ? stop : start).focus({ preventScroll: true });
  }
  function aim(x, y) {
    at = { x: Math.min(Math.max(x, 0), 1), y: Math.min(Math.max(y, 0), 1) };
    best = 0; // another place, another scale
    draw();
  }
  start.addEventListener("click", () => set(true));
  stop.addEventListener("click", () => set(false));
  const stage = one("stage");
  stage.addEventListener("click", (event) => {
    const box = picture.getBoundingClientRect();
    aim((event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height);
  });
  stage.addEventListener("keydown", (event) => {
    const by = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (!by) return;
    event.preventDefault();
    aim(at.x + by[0] * 0.03, at.y + by[1] * 0.03);
  });
  one("peaking").addEventListener("click", (event) => {
    peaking = !peaking;
    event.currentTarget.setAttribute("aria-pressed", String(peaking));
    draw();
  });
  one("times").addEventListener("click", () => {
    times = LOUPES[(LOUPES.indexOf(times) + 1) % LOUPES.length];
    one("times-word").textContent = `${times}×`;
    best = 0;
    draw();
  });
  const choices = panel.querySelectorAll("[data-live-camera]");
  choices.forEach((button) => button.addEventListener("click", () => {
    camera = button.dataset.liveCamera;
    choices.forEach((other) => other.setAttribute("aria-pressed", String(other === button)));
    best = 0; // another lens
    forget();
    view.classList.add("without-frame");
    say("Waiting for a frame…");
  }));
  document.addEventListener("visibilitychange", () => { if (document.hidden && open) set(false); });

  // On the guided screen, the live view belongs to the step in which the lens is focused.
  if (panel.hasAttribute("data-at-its-step")) {
    const follow = () => {
      panel.hidden = !document.querySelector("[data-lens-step]");
      if (panel.hidden && open) set(false);
    };
    document.addEventListener("part-changed", follow);
    follow();
  }
})();

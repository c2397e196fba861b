// Draws a region on the 3D view, corner by corner with pen, finger or mouse, and tells it to the page around this frame.
"use strict";

(() => {
  const place = document.getElementById("chart");
  const sheet = document.getElementById("region");
  const bar = document.querySelector("[data-to-view]");
  const said = document.getElementById("drawn");
  const toView = JSON.parse(bar.dataset.toView); // 4 x 4, metres: the frame of the scan to that of the drawing
  const near = 14; // pixels around the finger within which the frontmost point of the surface is meant
  let corners = []; // millimetres of the drawing

  const button = (name) => bar.querySelector(`[data-draw="${name}"]`);
  const scene = () => place._fullLayout.scene._scene;
  const times = (m, [x, y, z, w]) => [0, 1, 2, 3].map((row) => m[row] * x + m[row + 4] * y + m[row + 8] * z + m[row + 12] * w);

  // Pixels of the sheet, and depth, of a place in the drawing, by the matrices with which plotly draws.
  const projection = () => {
    const { model, view, projection: lens } = scene().glplot.cameraParams;
    const box = scene().container.getBoundingClientRect();
    const own = sheet.getBoundingClientRect();
    const scale = scene().dataScale;
    return ([x, y, z]) => {
      const [cx, cy, cz, cw] = times(lens, times(view, times(model, [x * scale[0], y * scale[1], z * scale[2], 1])));
      return [
        box.left - own.left + ((cx / cw + 1) / 2) * box.width,
        box.top - own.top + ((1 - cy / cw) / 2) * box.height,
        cz / cw,
      ];
    };
  };

  // The frontmost point of the surface under a finger; null beside the surface.
  const onSurface = (px, py) => {
    const surface = place._fullData.find((trace) => trace.name === "surface");
    if (!surface) return null;
    const project = projection();
    let found = null;
    let depth = Infinity;
    for (let k = 0; k < surface.x.length; k += 1) {
      const at = [surface.x[k], surface.y[k], surface.z[k]];
      const [x, y, z] = project(at);
      if (Math.hypot(x - px, y - py) <= near && z < depth) {
        depth = z;
        found = at;
      }
    }
    return found;
  };

  const show = () => {
    const project = corners.length ? projection() : null;
    const places = corners.map((corner) => project(corner));
    sheet.querySelector("polygon").setAttribute("points", places.map(([x, y]) => `${x},${y}`).join(" "));
    for (const old of sheet.querySelectorAll("circle")) old.remove();
    for (const [x, y] of places) {
      const dot = document.createElementNS("http://www.w3.org/2000/svg", "circle");
      dot.setAttribute("cx", x);
      dot.setAttribute("cy", y);
      dot.setAttribute("r", 7);
      sheet.append(dot);
    }
    const drawing = !sheet.hasAttribute("hidden");
    button("begin").disabled = drawing;
    button("undo").disabled = !drawing || corners.length === 0;
    button("end").disabled = !drawing || corners.length < 3;
    button("drop").disabled = !drawing;
  };

  const say = (text) => { said.textContent = text; };

  // A place of the drawing (mm) or, with weight 0, a direction, in the frame of the scan (m).
  const inScan = ([x, y, z], weight) => {
    const moved = [x, y, z].map((value, row) => (weight ? value / 1000 - toView[row][3] : value));
    return [0, 1, 2].map((column) => toView[0][column] * moved[0] + toView[1][column] * moved[1] + toView[2][column] * moved[2]);
  };

  // From the middle of the corners to the viewer; the box of plotly's camera has one unit for a metre.
  const alongView = () => {
    const { eye } = scene().getCamera();
    const ranges = ["xaxis", "yaxis", "zaxis"].map((axis) => place._fullLayout.scene[axis].range);
    const middle = ranges.map(([low, high]) => (low + high) / 2);
    const viewer = ["x", "y", "z"].map((axis, k) => 1000 * eye[axis] + middle[k]);
    const mean = [0, 1, 2].map((k) => corners.reduce((sum, corner) => sum + corner[k], 0) / corners.length);
    const way = viewer.map((value, k) => value - mean[k]);
    const length = Math.hypot(...way);
    return way.map((value) => value / length);
  };

  const acts = {
    begin: () => {
      corners = [];
      sheet.removeAttribute("hidden"); // SVG elements have no property of that name
      parent.postMessage({ region: null }, "*");
      say("Tap the corners on the surface. The view stays as it is until you close or discard the region.");
    },
    undo: () => { corners.pop(); },
    end: () => {
      const region = { corners: corners.map((corner) => inScan(corner, 1)), along: inScan(alongView(), 0) };
      sheet.setAttribute("hidden", "");
      parent.postMessage({ region }, "*");
      say(`${corners.length} corners. Record the region below the picture.`);
    },
    drop: () => {
      corners = [];
      sheet.setAttribute("hidden", "");
      parent.postMessage({ region: null }, "*");
      say("");
    },
  };

  bar.addEventListener("click", (event) => {
    const act = event.target.closest("button")?.dataset.draw;
    if (!act || !place._fullLayout?.scene) return;
    acts[act]();
    show();
  });

  sheet.addEventListener("pointerdown", (event) => {
    event.preventDefault();
    const own = sheet.getBoundingClientRect();
    const found = onSurface(event.clientX - own.left, event.clientY - own.top);
    if (found) corners.push(found);
    else say("There is no surface under this place.");
    show();
  });
})();

// Draws a region on the 3D view, corner by corner with pen, finger or mouse, and sends it to the page around this frame.
"use strict";

(() => {
  const place = document.getElementById("chart");
  const sheet = document.getElementById("region");
  const bar = document.querySelector("[data-to-view]");
  const said = document.getElementById("drawn");
  const toView = JSON.parse(bar.dataset.toView); // 4 x 4, metres: the frame of the scan to that of the drawing
  const near = 14; // pixels beside an edge of the surface within which that edge is meant
  let corners = []; // millimetres of the drawing

  const button = (name) => bar.querySelector(`[data-draw="${name}"]`);
  const scene = () => place._fullLayout.scene._scene;
  const times = (m, [x, y, z, w]) => [0, 1, 2, 3].map((row) => m[row] * x + m[row + 4] * y + m[row + 8] * z + m[row + 12] * w);

  // Pixels of the sheet, depth and distance of a point of the drawing, from plotly's own matrices.
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
        cw,
      ];
    };
  };

  // Barycentric coordinates of a pixel in a triangle of projected corners; null outside of it.
  const shares = ([ax, ay], [bx, by], [cx, cy], px, py) => {
    const whole = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay);
    const b = ((px - ax) * (cy - ay) - (cx - ax) * (py - ay)) / whole;
    const c = ((bx - ax) * (py - ay) - (px - ax) * (by - ay)) / whole;
    return b >= 0 && c >= 0 && b + c <= 1 ? [1 - b - c, b, c] : null;
  };

  // The point of the surface under a finger, in the drawing; outside its edge the nearest one; null if none is near.
  const onSurface = (px, py) => {
    const surface = place._fullData.find((trace) => trace.name === "surface");
    if (!surface) return null;
    const project = projection();
    const corner = (k) => [surface.x[k], surface.y[k], surface.z[k]];
    const seen = Array.from(surface.x, (_, k) => project(corner(k)));
    let found = null;
    let depth = Infinity;
    for (let k = 0; k < surface.i.length; k += 1) {
      const three = [surface.i[k], surface.j[k], surface.k[k]];
      const [a, b, c] = three.map((at) => seen[at]);
      if (Math.min(a[3], b[3], c[3]) <= 0) continue; // behind the viewer
      const share = shares(a, b, c, px, py);
      if (!share) continue;
      const z = share[0] * a[2] + share[1] * b[2] + share[2] * c[2];
      if (z >= depth) continue;
      depth = z;
      const weight = [a, b, c].map((at, m) => share[m] / at[3]); // the perspective shortens what is far
      const sum = weight[0] + weight[1] + weight[2];
      found = [0, 1, 2].map((axis) => three.reduce((at, v, m) => at + (weight[m] / sum) * corner(v)[axis], 0));
    }
    if (found) return found;
    let best = near;
    seen.forEach(([x, y, , w], k) => {
      const away = Math.hypot(x - px, y - py);
      if (w > 0 && away <= best) {
        best = away;
        found = corner(k);
      }
    });
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

  // A point of the drawing (mm), or with weight 0 a direction, in the frame of the scan (m).
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

  // The picture may have another size now: draw the corners again.
  place.on?.("plotly_afterplot", () => { if (corners.length) show(); });

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

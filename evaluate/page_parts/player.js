// Plays the manoeuvres from above: data-manoeuvre names one of the drives in #drives.
(() => {
  const drives = JSON.parse(document.getElementById("drives").textContent);
  const still = matchMedia("(prefers-reduced-motion: reduce)");
  const pace = 1.0; // real time
  const hold = 1.2; // seconds at the end before the loop starts again

  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

  const poseAt = (poses, frame) => {
    const low = Math.min(Math.floor(frame), poses.length - 1);
    const high = Math.min(low + 1, poses.length - 1);
    const part = Math.min(frame - low, 1);
    return poses[low].map((value, i) => value + part * (poses[high][i] - value));
  };

  const player = (figure) => {
    const drive = drives[figure.dataset.manoeuvre];
    const panels = [...figure.querySelectorAll("canvas")];
    const speeds = [...figure.querySelectorAll(".speed")];
    const button = figure.querySelector("button");
    const slider = figure.querySelector("input");
    const clock = figure.querySelector(".clock");
    const frames = Math.max(...drive.cars.map((car) => car.poses.length)) - 1;
    const end = frames * drive.frame_s;
    const [x0, x1] = drive.view.x;
    const [y0, y1] = drive.view.y;
    let time = 0, playing = false, before = null, visible = false;
    slider.max = end;

    const drawRoad = (pen, metre) => {
      const lane = (offset, width, style, dash) => {
        pen.beginPath();
        drive.path.forEach(([x, y]) => pen.lineTo(x, y + offset));
        pen.lineWidth = width; pen.strokeStyle = style; pen.setLineDash(dash); pen.stroke();
      };
      pen.lineJoin = "round";
      if (!drive.view.follow) { // along the path
        lane(0, drive.lane_m + 0.3, colour("--edge"), []);
        lane(0, drive.lane_m, colour("--road"), []);
      } else { // straight lanes
        const low = drive.view.lanes[0] - drive.lane_m / 2;
        const high = drive.view.lanes.at(-1) + drive.lane_m / 2;
        pen.fillStyle = colour("--edge"); pen.fillRect(x0 - 9, low - 0.15, x1 - x0 + 18, high - low + 0.3);
        pen.fillStyle = colour("--road"); pen.fillRect(x0 - 9, low, x1 - x0 + 18, high - low);
        drive.view.lanes.slice(1).forEach((middle) => {
          const y = middle - drive.lane_m / 2;
          pen.beginPath(); pen.moveTo(x0 - 9, y); pen.lineTo(x1 + 9, y);
          pen.lineWidth = 0.15; pen.strokeStyle = colour("--mark"); pen.setLineDash([3, 6]); pen.stroke();
        });
      }
      lane(0, Math.max(0.12, 0.8 / metre), colour("--mark"), [1, 3]);
      pen.setLineDash([]);
    };

    const drawBody = (pen, x, y, heading, length, width, behind, fill) => {
      pen.save();
      pen.translate(x, y); pen.rotate(heading);
      pen.fillStyle = fill;
      pen.beginPath(); pen.roundRect(-behind, -width / 2, length, width, 0.5); pen.fill();
      pen.fillStyle = colour("--glass");
      pen.beginPath(); pen.roundRect(-behind + 0.62 * length, -width * 0.38, 0.13 * length, width * 0.76, 0.2);
      pen.fill();
      pen.restore();
    };

    const draw = () => {
      const frame = time / drive.frame_s;
      const places = drive.cars.map((car) => poseAt(car.poses, frame));
      drive.cars.forEach((car, i) => {
        const canvas = panels[i], pen = canvas.getContext("2d");
        const box = canvas.getBoundingClientRect(), dots = devicePixelRatio || 1;
        const w = Math.round(box.width * dots), h = Math.round(box.height * dots);
        if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
        // On a narrow screen a straight road is shown in part, and the view goes along with the cars.
        const fit = Math.min(w / (x1 - x0), h / (y1 - y0));
        const metre = drive.view.follow ? Math.max(fit, h / (y1 - y0)) : fit;
        const half = w / metre / 2, mean = places.reduce((sum, [x]) => sum + x, 0) / places.length;
        const middle = metre > fit ? Math.min(Math.max(mean, x0 + half), x1 - half) : (x0 + x1) / 2;
        pen.setTransform(1, 0, 0, 1, 0, 0);
        pen.clearRect(0, 0, w, h);
        pen.setTransform(metre, 0, 0, -metre, w / 2 - metre * middle, (h + metre * (y0 + y1)) / 2);
        drawRoad(pen, metre);
        const accent = colour(`--${car.style}`);
        pen.beginPath();
        car.poses.slice(0, Math.floor(frame) + 1).forEach(([x, y]) => pen.lineTo(x, y));
        pen.strokeStyle = accent; pen.globalAlpha = 0.45; pen.lineWidth = Math.max(0.35, 2 / metre);
        pen.stroke(); pen.globalAlpha = 1;
        drive.others.forEach((other) => {
          const [x, y] = poseAt(other.at, frame);
          drawBody(pen, x, y, 0, other.length, other.width, other.length / 2, colour("--other"));
        });
        const [x, y, heading, speed] = places[i];
        const { length, width, behind } = drive.car;
        drawBody(pen, x, y, heading, length, width, behind, accent);
        speeds[i].textContent = `${speed.toFixed(0)} km/h`;
      });
      clock.textContent = `${Math.min(time, end).toFixed(1)} s`;
      slider.value = time;
    };

    const step = (now) => {
      if (!playing) return;
      if (before !== null && visible) {
        time += pace * (now - before) / 1000;
        if (time > end + hold) time = 0;
        draw();
      }
      before = now;
      requestAnimationFrame(step);
    };
    const play = (on) => {
      playing = on; before = null;
      button.textContent = on ? "Pause" : "Play";
      button.setAttribute("aria-pressed", on);
      if (on) requestAnimationFrame(step);
    };

    button.addEventListener("click", () => {
      if (!playing && time >= end) time = 0;
      play(!playing);
    });
    slider.addEventListener("input", () => { play(false); time = Number(slider.value); draw(); });
    new IntersectionObserver(([seen]) => { visible = seen.isIntersecting; }).observe(figure);
    new ResizeObserver(draw).observe(figure);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
    still.addEventListener("change", () => play(!still.matches));
    if (still.matches) { time = 0.45 * end; draw(); } else play(true);
  };

  document.querySelectorAll("figure[data-manoeuvre]").forEach(player);
})();

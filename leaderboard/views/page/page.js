"use strict";
(() => {
  const root = document.documentElement;
  const data = JSON.parse(document.getElementById("data").textContent);
  const narrow = () => window.innerWidth < 720;
  root.classList.remove("no-script");

  // ---- theme: the reader's choice, otherwise the system's ---------------------------------------------------

  const dark = matchMedia("(prefers-color-scheme: dark)");
  const button = document.getElementById("theme");
  const theme = () => root.dataset.theme || (dark.matches ? "dark" : "light");

  function nameTheme() {
    button.textContent = theme() === "dark" ? "Light theme" : "Dark theme";
  }

  // A file opened from disk may have no storage.
  try { root.dataset.theme = localStorage.getItem("theme") || ""; } catch { /* the system's theme */ }
  button.addEventListener("click", () => {
    root.dataset.theme = theme() === "dark" ? "light" : "dark";
    try { localStorage.setItem("theme", root.dataset.theme); } catch { /* until the page is closed */ }
    nameTheme();
  });
  dark.addEventListener("change", nameTheme);
  nameTheme();

  // ---- tables: sort and filter -----------------------------------------------------------------------------

  function prepare(part) {
    const table = part.querySelector(".board");
    const heads = [...table.tHead.rows[0].cells];
    const bodies = [...table.tBodies];
    const rows = bodies.flatMap((body) => [...body.rows].slice(1).map((row) => ({ row, body })));
    const form = part.querySelector(".filters");
    const sorted = heads.find((head) => head.ariaSort !== "none");
    let column = heads.indexOf(sorted), direction = sorted.ariaSort;

    function compare(a, b) {
      const [x, y] = [a, b].map(({ row }) => row.cells[column].dataset.order);
      if (!x || !y) return (x ? 0 : 1) - (y ? 0 : 1); // missing values come last in both directions
      const order = isNaN(x) || isNaN(y) ? x.localeCompare(y, "en") : x - y;
      return direction === "ascending" ? order : -order;
    }

    function arrange() {
      const grouped = !form || form.elements.grouped.checked;
      table.classList.toggle("grouped", grouped);
      for (const one of [...rows].sort(compare)) (grouped ? one.body : bodies[0]).append(one.row);
      heads.forEach((head, number) => { head.ariaSort = number === column ? direction : "none"; });
    }

    function filter() {
      const { text, tier } = form.elements;
      const wanted = text.value.trim().toLowerCase();
      const divisions = [...form.querySelectorAll("[name=division]:checked")].map((box) => box.value);
      let count = 0;
      for (const { row } of rows) {
        const name = row.querySelector(".name").textContent.toLowerCase();
        row.hidden = !name.includes(wanted) || !divisions.includes(row.dataset.division)
          || (tier.value !== "" && row.dataset.tier !== tier.value);
        count += !row.hidden;
      }
      for (const body of bodies) {
        body.rows[0].hidden = rows.every((one) => one.body !== body || one.row.hidden);
      }
      form.elements.count.value = `${count} of ${rows.length} methods`;
    }

    table.tHead.addEventListener("click", (event) => {
      const head = event.target.closest("th");
      if (!event.target.closest("button")) return;
      const first = event.target.closest("button").dataset.first;
      const other = { ascending: "descending", descending: "ascending" };
      direction = heads.indexOf(head) === column ? other[direction] : first;
      column = heads.indexOf(head);
      arrange();
    });
    table.addEventListener("click", (event) => {
      const link = event.target.closest("tbody tr")?.querySelector(".name a");
      if (link && !event.target.closest("a") && !getSelection().toString()) link.click();
    });
    form?.addEventListener("input", () => { arrange(); filter(); });
    form?.addEventListener("submit", (event) => event.preventDefault());
    form?.reset();
  }

  for (const table of document.querySelectorAll(".board")) prepare(table.closest(".part"));

  const files = document.getElementById("not-shown");
  files.querySelector(".filters")?.addEventListener("input", ({ currentTarget: form }) => {
    const rows = [...files.querySelector("tbody").rows];
    const wanted = form.elements.text.value.trim().toLowerCase();
    for (const row of rows) row.hidden = !row.textContent.toLowerCase().includes(wanted);
    form.elements.count.value = `${rows.filter((row) => !row.hidden).length} of ${rows.length} files`;
  });
  files.querySelector(".filters")?.addEventListener("submit", (event) => event.preventDefault());

  // ---- charts ----------------------------------------------------------------------------------------------

  const tip = document.getElementById("tip");

  function showTip(handler, event, item, value) {
    if (!value) return tip.hidePopover();
    tip.textContent = Object.entries(value).map(([name, text]) => `${name}: ${text}`).join("\n");
    tip.showPopover();
    const left = Math.min(event.clientX + 12, window.innerWidth - tip.offsetWidth - 8);
    const below = event.clientY + 12 + tip.offsetHeight < window.innerHeight;
    tip.style.left = `${Math.max(left, 8)}px`;
    tip.style.top = `${below ? event.clientY + 12 : event.clientY - 12 - tip.offsetHeight}px`;
  }

  async function draw(element, spec) {
    // `ast` interprets expressions: the policy of the page forbids code made from text.
    const options = { actions: false, ast: true, renderer: "svg", defaultStyle: false, tooltip: showTip };
    // Vega sets its own class names on the element that it draws in.
    const { view } = await vegaEmbed(element.appendChild(document.createElement("div")), spec, options);
    view.addEventListener("click", (event, item) => {
      if (item?.datum?.anchor) location.hash = `#${item.datum.anchor}`;
    });
  }

  function drawPlane(element) {
    const one = data.scenarios[element.dataset.plane];
    draw(element, narrow() ? one.narrow : one.wide);
  }

  function drawFrontier(element) {
    const one = data.scenarios[element.dataset.frontier];
    draw(element, narrow() ? one.narrow_frontier : one.wide_frontier);
  }

  function drawDecoders(element) {
    const one = data.scenarios[element.dataset.decoders];
    draw(element, narrow() ? one.narrow_decoders : one.wide_decoders);
  }

  const words = ([value, low, high]) =>
    value === null ? "–" : value.toFixed(2) + (low === null ? "" : ` [${low.toFixed(2)}, ${high.toFixed(2)}]`);

  /* The evaluations of a run in order: stage and step of each point of the curves of old skills and targets. */
  function places({ steps, targets }) {
    const each = (from) => targets.flatMap((_, stage) => from.map((step) => [stage, step]));
    return { retained: [[0, 0], ...each(steps)], target: each([0, ...steps]) };
  }

  /* Where stages end when the target is learned, their length differs between runs: a stage is one step long. */
  const when = (one, step) => one.to_criterion ? ["start", "end"][step] : String(step);

  function points(series, numbers, at, one, perStage) {
    return numbers.flatMap(([y, low, high], index) => {
      if (y === null) return [];
      const [stage, step] = at[index];
      const x = stage * one.steps.at(-1) + step;
      return [{
        series, x, y, low: low ?? y, high: high ?? y, stage: series + (perStage ? stage : ""),
        at: one.to_criterion ? `${when(one, step)} of stage ${stage + 1}` : `step ${x}`, success: words([y, low, high]),
      }];
    });
  }

  function drawRun(element) {
    const row = data.rows[element.dataset.run];
    const one = data.scenarios[row.scenario];
    const at = places(one);
    const [retained, target, beside] = data.series;
    const all = [
      ...points(retained, row.retained, at.retained, one, false),
      ...points(target, row.target, at.target, one, true),
    ];
    if (one.sft && one.sft !== element.dataset.run) {
      const values = data.rows[one.sft].retained.map(([value]) => [value, null, null]);
      all.push(...points(beside, values, at.retained, one, false));
    }
    const shown = [...new Set(all.map((point) => point.series))];
    draw(element, { ...one.run, params: [{ name: "shown", value: shown }], datasets: { points: all } });
  }

  // ---- tables that are long and made when they open -------------------------------------------------

  function table(label, heads, rows) {
    const region = document.createElement("div");
    Object.assign(region, { className: "scroll", tabIndex: 0, role: "region", ariaLabel: label });
    const made = region.appendChild(document.createElement("table"));
    made.className = "plain";
    const cell = (row, name, text, numeric) => {
      const one = row.appendChild(document.createElement(name));
      if (name === "th") one.scope = row.parentElement.tagName === "THEAD" ? "col" : "row";
      one.className = numeric ? "numeric" : "";
      one.textContent = text;
      return one;
    };
    const head = made.createTHead().insertRow();
    heads.forEach((text, number) => cell(head, "th", text, number > 0));
    const body = made.createTBody();
    for (const { texts, title } of rows) {
      const row = body.insertRow();
      texts.forEach((text, number) => cell(row, number ? "td" : "th", text, number > 0));
      if (title) row.title = title;
    }
    return region;
  }

  const tables = {
    curves(row) {
      const one = data.scenarios[row.scenario], count = one.steps.length;
      const rows = places(one).target.map(([stage, step], index) => {
        const place = index - stage * (count + 1);
        return { texts: [one.targets[stage], when(one, step), words(row.target[index]), words(row.retained[stage * count + place])] };
      });
      return table("The curves", ["target", "step", "success on the target", "on the old skills"], rows);
    },
    metrics(row) {
      const seeds = Object.keys(row.seeds);
      const rows = row.metrics.map((numbers, index) => {
        const [name, description, missing] = data.scenarios[row.scenario].metrics[index];
        const [value, low, high, ...each] = numbers;
        const texts = [name, words([value, low, high]), ...each.map((one) => words([one, null, null]))];
        return { texts, title: value === null ? `Missing: ${missing}` : description };
      });
      const heads = ["metric", "value [95 % interval]", ...seeds.map((seed) => `seed ${seed}`)];
      return table("All other metrics and definitions", heads, rows);
    },
  };

  document.addEventListener("toggle", ({ target }) => {
    const make = tables[target.dataset?.table];
    if (!make || !target.open || target.children.length > 1) return;
    target.append(make(data.rows[target.closest("dialog").id]));
  }, true);

  function drawInside(part) {
    for (const element of part.querySelectorAll("[data-plane], [data-frontier], [data-decoders], [data-run]")) {
      const hidden = element.closest("dialog:not([open])");
      if (hidden || element.dataset.drawn) continue;
      element.dataset.drawn = "yes";
      const { plane, frontier, decoders } = element.dataset;
      (plane ? drawPlane : frontier ? drawFrontier : decoders ? drawDecoders : drawRun)(element);
    }
  }

  // ---- the success matrix of one seed ----------------------------------------------------------------------

  document.addEventListener("click", (event) => {
    const chosen = event.target.closest("[data-seed]");
    if (!chosen) return;
    const dialog = chosen.closest("dialog");
    const matrix = dialog.querySelector(".matrix");
    matrix.mean ??= [...matrix.tBodies[0].rows].map((row) => [...row.cells].slice(1).map((cell) => cell.textContent));
    const seed = data.rows[dialog.id].seeds[chosen.dataset.seed];
    [...matrix.tBodies[0].rows].forEach((row, stage) => [...row.cells].slice(1).forEach((cell, task) => {
      const value = seed ? seed[stage][task] : parseFloat(matrix.mean[stage][task]);
      const known = value !== null && !isNaN(value);
      cell.textContent = known ? value.toFixed(2) : "–";
      cell.className = cell.className.replace(/^\S+/, known ? `s${Math.round(value * 20)}` : "none");
    }));
    for (const other of chosen.parentElement.children) other.ariaPressed = String(other === chosen);
  });

  // ---- places: #scenario shows a scenario, #scenario/method opens a row ------------------------------------

  const parts = [...document.querySelectorAll(".part:not(.always)")];
  const links = [...document.querySelectorAll(".top nav a")];

  function go() {
    const name = decodeURIComponent(location.hash.slice(1));
    const target = document.getElementById(name);
    const part = target?.closest(".part:not(.always)") ?? parts.find((one) => !one.hidden) ?? parts[0];
    for (const one of parts) one.hidden = one !== part;
    for (const link of links) {
      link.toggleAttribute("aria-current", part && link.hash.slice(1) === part.id);
      if (link.hasAttribute("aria-current")) link.setAttribute("aria-current", "true");
    }
    for (const dialog of document.querySelectorAll("dialog[open]")) if (dialog !== target) dialog.close("moved");
    if (target?.matches("dialog.row")) {
      if (!target.open) target.showModal();
      target.querySelector("h2").focus();
      target.scrollTop = 0;
      drawInside(target);
    } else if (target?.matches(".part")) {
      target.scrollIntoView();
    }
    if (part) drawInside(part);
  }

  document.addEventListener("close", ({ target: dialog }) => {
    // Closed by a key or a click: restore the address of the scenario, and the focus on the row.
    if (dialog.returnValue !== "moved") {
      const part = dialog.closest(".part");
      history.replaceState(null, "", `#${part.id}`);
      [...part.querySelectorAll(".board .name a")].find((link) => link.hash === `#${dialog.id}`)?.focus();
    }
    dialog.returnValue = "";
    tip.hidePopover();
  }, true);
  document.addEventListener("click", (event) => {
    const close = event.target.closest("dialog .close");
    const outside = event.target.matches("dialog.row"); // the backdrop is the dialog itself
    if (!close && !(outside && event.clientX < event.target.getBoundingClientRect().left)) return;
    event.preventDefault();
    event.target.closest("dialog").close();
  });
  window.addEventListener("hashchange", go);
  parts.slice(1).forEach((part) => { part.hidden = true; });
  go();
})();

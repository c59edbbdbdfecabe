// The choices that a page with triangles offers in addition to those of every page.

const LABELS = {
  kmeans: "Atlas k-means", affine: "Atlas affine", grid: "Atlas grid",
  mlp_constants: "MLP constants", mlp_textures: "MLP textures", none: "None",
  stop: "Stop", ztest: "Depth test", cutout: "Cutout",
};

// The initial choices, in the form that Picture.look() takes. The page's controls change them later.
function choicesOf(viewer) {
  const { modes, triangles } = viewer.facts, choices = {};
  // A page of triangles or splats alone has no lookup, level of detail or cut, and triangles have no crop box.
  for (const name of modes ? ["lookup", "detail", "cut"] : []) element(name).parentElement.hidden = true;
  for (const told of modes ? [...document.querySelectorAll(".of_voxels")] : []) told.remove();
  for (const name of viewer.facts.kind === "surface" ? ["clip", "whole", "clip_told"] : []) element(name).hidden = true;
  for (const option of [...element("mode").options]) if (modes && !modes.includes(option.value)) option.remove();
  element("modes_told").textContent = String(element("mode").options.length);
  for (const [name, values] of [["highlights", triangles?.highlights], ["composite", triangles?.composites]]) {
    if (values?.length > 1) choices[name] = offered(viewer, name, values);
    else element(name).parentElement.remove();
  }
  if (choices.composite) choices.shadow = switched(viewer, "shadow");
  else element("shadow").remove();
  return choices;
}

// Make a button a switch that is off at first.
function switched(viewer, name) {
  const button = element(name);
  button.hidden = false;
  button.addEventListener("click", () => viewer.choose(name, !viewer.choices[name]));
  return false;
}

// Fill a select element, and return the first of its values.
function offered(viewer, name, values) {
  const select = element(name);
  for (const value of values) select.add(new Option(LABELS[value], value));
  select.parentElement.hidden = false;
  select.addEventListener("change", () => viewer.choose(name, select.value));
  return values[0];
}

// Show a choice in its control, also if a script made it.
function markChoice(name, value) {
  if (typeof value === "boolean") element(name).ariaPressed = String(value);
  else element(name).value = value;
}

// Generates what the page knows of the API from openapi.json: the types of the client (schema.d.ts), and the settings
// of an experiment (settings.json), from which the form for a new experiment is built.
//
//   node scripts/generate-client.mjs           writes both files
//   node scripts/generate-client.mjs --check   fails when they differ from what would be written
import { execFileSync } from "node:child_process";
import { mkdtempSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { fileURLToPath } from "node:url";

const page = fileURLToPath(new URL("..", import.meta.url));
const TYPES = "src/shared/api/schema.d.ts";
const SETTINGS = "src/features/new-experiment/settings.json";

function typesOf() {
  const folder = mkdtempSync(join(tmpdir(), "accord-client-"));
  const output = join(folder, "schema.d.ts");
  const cli = join(page, "node_modules", "openapi-typescript", "bin", "cli.js");
  try {
    execFileSync(process.execPath, [cli, "openapi.json", "--output", output], { cwd: page, stdio: "pipe" });
    return readFileSync(output, "utf8");
  } finally {
    rmSync(folder, { recursive: true, force: true });
  }
}

function settingsOf() {
  const openapi = JSON.parse(readFileSync(join(page, "openapi.json"), "utf8"));
  const { properties, required } = inlined(openapi.components.schemas.NewExperiment, openapi);
  return `${JSON.stringify({ properties, required }, null, 1)}\n`;
}

/** The schema with every $ref replaced by what it refers to. */
function inlined(schema, openapi) {
  if (Array.isArray(schema)) return schema.map((item) => inlined(item, openapi));
  if (typeof schema !== "object" || schema === null) return schema;
  const { $ref, ...rest } = schema;
  const target = $ref
    ?.split("/")
    .slice(1)
    .reduce((node, key) => node[key], openapi);
  return Object.fromEntries(
    Object.entries({ ...target, ...rest }).map(([key, value]) => [key, inlined(value, openapi)]),
  );
}

const check = process.argv.includes("--check");
for (const [path, content] of [
  [TYPES, typesOf()],
  [SETTINGS, settingsOf()],
]) {
  const file = join(page, path);
  if (!check) writeFileSync(file, content);
  else if (readFileSync(file, "utf8") !== content) {
    console.error(`${path} is out of date: run \`npm run generate\` and commit the result.`);
    process.exitCode = 1;
  }
}

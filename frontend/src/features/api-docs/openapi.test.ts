import { expect, test } from "vitest";
import { namedIn, type OpenApi, routesByTag, typeText } from "./openapi";

const label = { $ref: "#/components/schemas/Label" };

test("types are described with their range, choices and parts", () => {
  expect(typeText({ type: "integer", minimum: 1, maximum: 16 })).toBe("integer from 1 to 16");
  expect(typeText({ anyOf: [{ type: "array", items: label }, { type: "null" }] })).toBe(
    "list of Label or null",
  );
  expect(typeText({ enum: ["label", "skip"] })).toBe('"label" or "skip"');
  expect(typeText(undefined)).toBe("anything");
  expect(namedIn({ anyOf: [{ type: "array", items: label }, { type: "null" }] })).toEqual(["Label"]);
});

test("operations are grouped by their first tag", () => {
  const untagged = { operationId: "me", summary: "Get the user", responses: {} };
  const document: OpenApi = {
    info: { description: "" },
    paths: { "/me": { get: { ...untagged, tags: ["accounts"] }, put: untagged } },
    components: { schemas: {} },
  };
  const groups = routesByTag(document).map(([tag, routes]) => [tag, routes.map((each) => each.method)]);
  expect(groups).toEqual([
    ["accounts", ["GET"]],
    ["other", ["PUT"]],
  ]);
});

/** The part of an OpenAPI 3.1 document that the page shows. */
export interface OpenApi {
  info: { description: string };
  paths: Record<string, Record<string, Operation>>;
  components: { schemas: Record<string, Schema> };
}

export interface Operation {
  operationId: string;
  summary: string;
  description?: string;
  tags?: string[];
  security?: unknown[];
  parameters?: Parameter[];
  requestBody?: Body;
  responses: Record<string, Body>;
}

export interface Parameter {
  name: string;
  in: string;
  required?: boolean;
  description?: string;
  schema?: Schema;
}

interface Body {
  description?: string;
  content?: Record<string, { schema?: Schema }>;
}

export interface Schema {
  $ref?: string;
  type?: string;
  description?: string;
  properties?: Record<string, Schema>;
  required?: string[];
  items?: Schema;
  anyOf?: Schema[];
  enum?: unknown[];
  const?: unknown;
  default?: unknown;
  minimum?: number;
  maximum?: number;
  exclusiveMinimum?: number;
  exclusiveMaximum?: number;
  maxLength?: number;
}

export interface Route extends Operation {
  method: string;
  path: string;
}

/** The operations by their first tag, in the order of the document. */
export function routesByTag(document: OpenApi): [string, Route[]][] {
  const groups = new Map<string, Route[]>();
  for (const [path, methods] of Object.entries(document.paths)) {
    for (const [method, operation] of Object.entries(methods)) {
      const tag = operation.tags?.[0] ?? "other";
      const group = groups.get(tag) ?? [];
      group.push({ ...operation, method: method.toUpperCase(), path });
      groups.set(tag, group);
    }
  }
  return [...groups];
}

/** The name of the schema that a reference points at. */
export function referenceOf(schema: Schema): string | undefined {
  return schema.$ref?.split("/").at(-1);
}

/** The names of all schemas in a type, for links: `list of Label or null` names Label. */
export function namedIn(schema: Schema | undefined): string[] {
  if (!schema) return [];
  const name = referenceOf(schema);
  if (name) return [name];
  return [...namedIn(schema.items), ...(schema.anyOf ?? []).flatMap(namedIn)];
}

/** A type in words, with its choices and its range: `integer from 1 to 16`. */
export function typeText(schema: Schema | undefined): string {
  if (!schema) return "anything";
  const name = referenceOf(schema);
  if (name) return name;
  if (schema.anyOf) return schema.anyOf.map(typeText).join(" or ");
  if (schema.enum) return schema.enum.map((each) => JSON.stringify(each)).join(" or ");
  if (schema.const !== undefined) return JSON.stringify(schema.const);
  if (schema.type === "array") return `list of ${typeText(schema.items)}`;
  return `${schema.type ?? "anything"}${rangeText(schema)}`;
}

function rangeText(schema: Schema): string {
  const parts: string[] = [];
  if (schema.minimum !== undefined) parts.push(`from ${schema.minimum}`);
  if (schema.exclusiveMinimum !== undefined) parts.push(`above ${schema.exclusiveMinimum}`);
  if (schema.maximum !== undefined) parts.push(`to ${schema.maximum}`);
  if (schema.exclusiveMaximum !== undefined) parts.push(`below ${schema.exclusiveMaximum}`);
  if (schema.maxLength !== undefined) parts.push(`of at most ${schema.maxLength} characters`);
  return parts.length === 0 ? "" : ` ${parts.join(" ")}`;
}

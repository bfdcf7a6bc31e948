import { useQuery } from "@tanstack/react-query";
import { errorMessage } from "@/shared/api/errors";
import { openApiQuery } from "@/shared/api/queries";
import { Alert } from "@/shared/ui/Message";
import { namedIn, type OpenApi, type Route, routesByTag, type Schema, typeText } from "./openapi";
import "./api-docs.css";

/** The REST API, as its OpenAPI document describes it: operations by topic, then what they send and return. */
export function ApiDocsPage() {
  const { data, error } = useQuery(openApiQuery);
  return (
    <main className="page api-docs" id="content">
      <div className="page-head">
        <h1>REST API</h1>
        <a className="button" href="/api/openapi.json">
          OpenAPI document
        </a>
      </div>
      {error && <Alert>{errorMessage(error)}</Alert>}
      {data !== undefined && <Reference document={data as OpenApi} />}
    </main>
  );
}

function Reference({ document }: { document: OpenApi }) {
  return (
    <>
      <p>
        <WithCode text={document.info.description} />
      </p>
      {routesByTag(document).map(([tag, routes]) => (
        <section key={tag} aria-labelledby={`tag-${tag}`}>
          <h2 id={`tag-${tag}`}>{tag}</h2>
          {routes.map((route) => (
            <Endpoint key={route.operationId} route={route} />
          ))}
        </section>
      ))}
      <section aria-labelledby="schemas">
        <h2 id="schemas">Bodies</h2>
        {Object.entries(document.components.schemas).map(([name, schema]) => (
          <div key={name} id={`schema-${name}`}>
            <h3>{name}</h3>
            {schema.description && (
              <p>
                <WithCode text={schema.description} />
              </p>
            )}
            {schema.enum && <p>{typeText(schema)}</p>}
            {schema.properties && <Fields of={schema} />}
          </div>
        ))}
      </section>
    </>
  );
}

function Endpoint({ route }: { route: Route }) {
  const body = route.requestBody?.content?.["application/json"]?.schema;
  return (
    <details>
      <summary>
        <code>
          {route.method} {route.path}
        </code>{" "}
        {route.summary}
      </summary>
      <div className="api-endpoint">
        {route.description && (
          <p>
            <WithCode text={route.description} />
          </p>
        )}
        {route.security?.length === 0 && <p>Needs no sign-in.</p>}
        {route.parameters && (
          <Table
            title="Parameters"
            rows={route.parameters.map((each) => ({
              name: each.name,
              note: each.required ? `${each.in}, required` : each.in,
              schema: each.schema,
              description: each.description,
            }))}
          />
        )}
        {body && (
          <p>
            Body: <TypeLinks schema={body} />
          </p>
        )}
        <ul className="bullets">
          {Object.entries(route.responses).map(([status, response]) => (
            <li key={status}>
              {status === "default" ? "Errors" : status}:{" "}
              {Object.entries(response.content ?? {}).map(([type, { schema }]) =>
                type === "application/json" ? (
                  <TypeLinks key={type} schema={schema} />
                ) : (
                  <code key={type}>{type}</code>
                ),
              )}{" "}
              <WithCode text={response.description ?? ""} />
            </li>
          ))}
        </ul>
      </div>
    </details>
  );
}

function Fields({ of: { properties = {}, required = [] } }: { of: Schema }) {
  return (
    <Table
      title="Fields"
      rows={Object.entries(properties).map(([name, schema]) => ({
        name,
        note:
          schema.default === undefined
            ? required.includes(name)
              ? "required"
              : ""
            : `default ${JSON.stringify(schema.default)}`,
        schema,
        description: schema.description,
      }))}
    />
  );
}

interface Row {
  name: string;
  note: string;
  schema: Schema | undefined;
  description: string | undefined;
}

function Table({ title, rows }: { title: string; rows: readonly Row[] }) {
  return (
    <table className="table" aria-label={title}>
      <thead>
        <tr>
          <th scope="col">Name</th>
          <th scope="col">Type</th>
          <th scope="col">Meaning</th>
        </tr>
      </thead>
      <tbody>
        {rows.map(({ name, note, schema, description }) => (
          <tr key={name}>
            <th scope="row">
              <code>{name}</code>
              {note && <span className="cell-note muted">{note}</span>}
            </th>
            <td>
              <TypeLinks schema={schema} />
            </td>
            <td>
              <WithCode text={description ?? ""} />
            </td>
          </tr>
        ))}
      </tbody>
    </table>
  );
}

/** A type in words; the names of schemas in it are links to their fields. */
function TypeLinks({ schema }: { schema: Schema | undefined }) {
  const names = namedIn(schema);
  const words = typeText(schema).split(" ");
  return (
    <>
      {words.map((word, position) => (
        // biome-ignore lint/suspicious/noArrayIndexKey: the words of a type never change
        <span key={position}>
          {position > 0 && " "}
          {names.includes(word) ? <a href={`#schema-${word}`}>{word}</a> : word}
        </span>
      ))}
    </>
  );
}

/** A text with code between backticks. */
function WithCode({ text }: { text: string }) {
  return text.split("`").map((part, index) =>
    // biome-ignore lint/suspicious/noArrayIndexKey: the parts of a text never change their order
    index % 2 ? <code key={index}>{part}</code> : part,
  );
}

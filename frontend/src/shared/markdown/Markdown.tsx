import { lexer, type Token, type Tokens } from "marked";
import { Fragment, type ReactNode } from "react";
import "./markdown.css";

/** `clip:clp_…`, or the address of a clip as copied from the page. */
const CLIP = /^(?:clip:|(?:https?:\/\/[^/]+)?\/api\/v1\/clips\/)(clp_[0-9a-f]{24})(?:\.mp4)?$/;

/**
 * Markdown as React elements, so that nothing in the text can become HTML or a script: raw HTML is shown as text, links
 * lead to http, https and mail addresses only, and the only images are clips of this server, `![caption](clip:clp_…)`.
 */
export function Markdown({ text }: { text: string }) {
  return <div className="markdown">{each(lexer(text, { gfm: true }), block)}</div>;
}

/** Every token as an element. Its position is a stable key, because the text changes as a whole. */
function each(tokens: readonly Token[] | undefined, render: (token: Tokens.Generic) => ReactNode): ReactNode {
  return tokens?.map((token, index) => (
    // biome-ignore lint/suspicious/noArrayIndexKey: see above
    <Fragment key={index}>{render(token as Tokens.Generic)}</Fragment>
  ));
}

function block(token: Tokens.Generic): ReactNode {
  switch (token.type) {
    case "heading":
      // The page and the dialog have headings of levels 1 and 2.
      return token.depth <= 2 ? <h3>{each(token.tokens, inline)}</h3> : <h4>{each(token.tokens, inline)}</h4>;
    case "paragraph":
      return <p>{each(token.tokens, inline)}</p>;
    case "list":
      return token.ordered ? (
        <ol start={token.start || 1}>{each(token.items, block)}</ol>
      ) : (
        <ul>{each(token.items, block)}</ul>
      );
    case "list_item":
      return <li>{each(token.tokens, block)}</li>;
    case "blockquote":
      return <blockquote>{each(token.tokens, block)}</blockquote>;
    case "code":
      return (
        <pre>
          <code>{token.text}</code>
        </pre>
      );
    case "hr":
      return <hr />;
    case "text":
      return token.tokens ? each(token.tokens, inline) : token.text;
    case "space":
    case "def":
      return null;
    default:
      return <p>{token.raw}</p>;
  }
}

function inline(token: Tokens.Generic): ReactNode {
  switch (token.type) {
    case "strong":
      return <strong>{each(token.tokens, inline)}</strong>;
    case "em":
      return <em>{each(token.tokens, inline)}</em>;
    case "del":
      return <del>{each(token.tokens, inline)}</del>;
    case "codespan":
      return <code>{token.text}</code>;
    case "br":
      return <br />;
    case "link":
      return /^(https?:|mailto:)/i.test(token.href) ? (
        <a href={token.href} target="_blank" rel="noreferrer">
          {each(token.tokens, inline)}
        </a>
      ) : (
        token.raw
      );
    case "image":
      return <ExampleClip href={token.href} caption={token.text} raw={token.raw} />;
    case "text":
      return token.tokens ? each(token.tokens, inline) : token.text;
    case "escape":
      return token.text;
    default:
      return token.raw;
  }
}

/** An example clip, which loops without sound. Any other image is shown as it was written. */
function ExampleClip({ href, caption, raw }: { href: string; caption: string; raw: string }) {
  const id = CLIP.exec(href)?.[1];
  if (!id) return raw;
  const path = `/api/v1/clips/${id}`;
  return (
    <span className="example-clip">
      <video
        src={`${path}.mp4`}
        poster={`${path}.jpg`}
        aria-label={caption || "Example clip"}
        muted
        loop
        playsInline
        autoPlay
        controls
        preload="metadata"
      />
      {caption && <span className="example-caption">{caption}</span>}
    </span>
  );
}

/** As `stripe_colour` in mapt.rendering.appearance: the stripes of agents whose colour is repeated. */
const STRIPES = ["#14191f", "#fff"];

/** A square in the colour of an agent in the clips, with the stripes that its limbs have there; nothing if it is not known. */
export function AgentSwatch({ colours, agent }: { colours: readonly string[]; agent: number }) {
  const colour = colours[agent];
  if (colour === undefined) return null;
  const repeats = colours.slice(0, agent).filter((other) => other === colour).length;
  const stripe = repeats > 0 ? STRIPES[(repeats - 1) % STRIPES.length] : colour;
  const background = `repeating-linear-gradient(90deg, ${colour} 0 3px, ${stripe} 3px 5px)`;
  return <span className="swatch" style={{ background }} aria-hidden="true" />;
}

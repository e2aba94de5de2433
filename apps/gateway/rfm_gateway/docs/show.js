// SPDX-License-Identifier: MIT
// Shows the gateway's endpoints with Swagger UI, which the page has loaded before.

window.SwaggerUIBundle({ url: "openapi.json", dom_id: "#swagger-ui", deepLinking: true });

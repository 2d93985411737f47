// A file of its own: the content security policy lets no script run that stands in a page. Without validatorUrl the
// page would ask a server of Swagger's whether the document is valid.
SwaggerUIBundle({url: "/openapi.json", dom_id: "#swagger-ui", deepLinking: true, validatorUrl: null});
